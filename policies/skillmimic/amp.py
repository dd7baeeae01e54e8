"""The discriminator of SkillMimic-AMP: does a transition look like the clips? Equation 15 pays -log(1 - D(s_t, s_t+1)).

A state here is what both a simulated robot with its ball and a clip have, seen from the base: height and tilt, joints, and
the ball. As in AMP (Peng et al., 2021, section 5), with their gradient penalty on transitions of the clips; the loss is
binary cross entropy, so that D is a probability and equation 15 can be taken as it is.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from policies.clips.kinematics import conjugate, rotate
from policies.skillmimic.clips import ReferenceClips
from policies.skillmimic.rewards import Motion

DOWN = np.array([0.0, 0.0, -1.0])


def features(m: Motion) -> np.ndarray:
    """(N, size) of a state, brought to about 1: nothing in it depends on where in the world the robot is, or its yaw."""
    back = conjugate(m.orientation_base_in_world)
    return np.concatenate(
        [
            m.points[:, 0, 2:],
            rotate(back, np.broadcast_to(DOWN, (len(back), 3))) * 3,
            m.joint_pos,
            m.joint_vel * 0.1,
            rotate(back, m.object_position - m.points[:, 0]) * 3,
            rotate(back, m.object_velocity) * 0.3,
        ],
        axis=1,
    )


class Discriminator:
    """``reward`` pays transitions (N, 2 size); ``learn`` tells those of the robots from those of the clips."""

    batch = 1024
    steps = 8  # a learning round
    memory = 100_000  # transitions of the robots that are kept
    penalty = 0.5  # of the squared gradient at the clips' transitions
    ceiling = 0.99  # of D: the reward ends at 4.6, and is divided by that

    def __init__(
        self,
        clips: ReferenceClips,
        reference: Callable[[np.ndarray, np.ndarray], Motion],
        substeps: int,
        seed: int,
    ) -> None:
        """``reference(rows, way)``: what robots are judged by, as ``ReferenceClips.motion``."""
        self.clips, self.reference, self.substeps = clips, reference, substeps
        self.rng = np.random.default_rng([seed, 15])
        torch.manual_seed(seed)
        size = 2 * features(reference(np.zeros(1, int), np.ones(1))).shape[1]
        self.network = nn.Sequential(nn.Linear(size, 256), nn.ELU(), nn.Linear(256, 128), nn.ELU(), nn.Linear(128, 1))
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=5e-4, weight_decay=1e-4)
        self._robots: deque[np.ndarray] = deque()

    def reward(self, transitions: np.ndarray) -> np.ndarray:
        """(N,) in [0, 1]: equation 15 over its ceiling; the transitions are remembered."""
        self._robots.append(transitions.astype(np.float32))
        while sum(map(len, self._robots)) > self.memory:
            self._robots.popleft()
        with torch.no_grad():
            real = torch.sigmoid(self.network(torch.from_numpy(self._robots[-1])))[:, 0]
        paid = -torch.log(1 - real.clamp(max=self.ceiling)) / -np.log(1 - self.ceiling)
        return paid.numpy().astype(float)

    def references(self, count: int) -> np.ndarray:
        """(count, 2 size) transitions of the clips, every skill and clip as often as episodes start in it."""
        clip, row = self.clips.sample(self.rng, count)
        before, after = (self.reference(*self.clips.rows(clip, row + k)) for k in (0, self.substeps))
        return np.concatenate([features(before), features(after)], axis=1)

    def learn(self) -> dict[str, float]:
        """Some gradient steps. Returns the loss, and how often it was right about robots and about clips."""
        robots = np.concatenate(self._robots)
        rows: list[tuple[float, float, float]] = []
        for _ in range(self.steps):
            fake = torch.from_numpy(robots[self.rng.integers(len(robots), size=self.batch)])
            real = torch.from_numpy(self.references(self.batch).astype(np.float32)).requires_grad_()
            says_fake, says_real = self.network(fake), self.network(real)
            loss = nn.functional.softplus(says_fake).mean() + nn.functional.softplus(-says_real).mean()
            slope: Tensor = torch.autograd.grad(says_real.sum(), real, create_graph=True)[0]
            total = loss + self.penalty * slope.square().sum(dim=1).mean()
            self.optimizer.zero_grad()
            total.backward()
            self.optimizer.step()
            rows.append(
                (float(loss.detach()), float((says_fake < 0).float().mean()), float((says_real > 0).float().mean()))
            )
        mean = np.mean(rows, axis=0)
        return {"loss_discriminator": float(mean[0]), "robots_found": float(mean[1]), "clips_found": float(mean[2])}

    def state_dict(self) -> dict:
        """Without the memory of transitions, which a resumed run collects anew."""
        return {"network": self.network.state_dict(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
