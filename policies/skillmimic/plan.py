"""What the arms do by plan, before any network: a skill's clip as targets, put right by optimisation and by feedback.

Liu & Hodgins (2018, section 4) track a clip with open-loop offsets found by trajectory optimisation and a linear feedback
from the ball, and learn on top. So here: ``optimise.py`` finds offsets at knots along the clip, and how far the palms
follow a ball that is not where the clip has it. The plan's clock runs with the ball where the ball sets the time (it is
caught, it bounces), and by itself elsewhere. Actions are a residual on all of this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import yaml
from torch import Tensor, nn

from sim2real.types import Sim2realError

ROOT = Path(__file__).resolve().parents[2]
GRAVITY = 9.81  # m/s^2
KNOTS = 8  # of a skill that moves
# The furthest that palms follow the ball: m forwards, left, up; rad tipped forwards, left.
REACH = np.array([0.15, 0.15, 0.25, 0.5, 0.5])
TIPS = slice(3, 5)  # of these
# Ticks that feet rest until it counts: who has just made a step still sways, and a ball that is let go flies off with that.
RESTED = 8.0
SETTLE = 17.0  # rows for which they go on resting before legs bend
LOST = 0.4  # m from its plan: a ball farther away does not come back
SLOW = 0.5  # m/s: a ball slower than this says little about the time
DEAD = 0.46  # m that a bounced ball comes up less high than planned: no stroke reaches it any more (terminations.DEAD)
NEVER = -100.0  # m: no ball is that low
# rad a tick: how fast targets go to where a skill begins. Arms that are thrown there throw the robot off its feet.
APPROACH, AT_ONCE = 0.04, 10.0


class Correction(NamedTuple):
    """What was optimised, of one skill."""

    offsets: np.ndarray  # (KNOTS, arms) rad, added to targets; all alike for a skill that holds still
    # What is in REACH per m that the ball is off: palms go after it, and tip with how far it is ahead or to the left, so
    # that they push it back.
    follow: np.ndarray  # (5,)
    damp: np.ndarray  # (5,) the same per m/s


@dataclass
class Rows:
    """One skill's targets, a row a policy period."""

    target: np.ndarray  # (T, arms) rad
    pose: np.ndarray  # (T, n) rad from home, how a base stands
    ball: np.ndarray  # (T, 3) m in the base
    velocity: np.ndarray  # (T, 3) m/s
    # rad of the arms whose palms have business with the ball, per m that they move, and per rad that they tip
    back: np.ndarray  # (T, arms, 5)
    loop: bool
    ready: bool  # it begins when the arms are there: neither a ball in the hands nor one in the air brings them
    bends: bool  # it moves the base
    away: np.ndarray  # (T,) bool: the ball comes back to both hands, and until then nothing else can begin
    pull: np.ndarray  # (T,) rows a tick per s that the ball is ahead, of a clock that follows it; 0: it runs by itself
    left: np.ndarray  # (T,) s for which the ball still rises: a palm that comes from above then meets it
    knots: np.ndarray = field(init=False)  # (T, KNOTS) shares of the knots in each row

    def __post_init__(self) -> None:
        count = len(self.target)
        at = np.arange(count) / max(count, 1) * KNOTS if self.loop else np.linspace(0, KNOTS - 1, count)
        gap = np.abs(at[:, None] - np.arange(KNOTS))
        if self.loop:
            gap = np.minimum(gap, KNOTS - gap)
        self.knots = np.maximum(1 - gap, 0.0)


class Planned(NamedTuple):
    """This tick of every robot."""

    target: Tensor  # (N, arms) rad
    pose: Tensor  # (N, n) rad from home, of the base
    clock: Tensor  # (N, 1) rows since the skill's beginning; negative while arms are on their way to it
    ball_error: Tensor  # (N, 6) m and m/s from where the plan has the ball
    lost: Tensor  # (N, 1) bool: arms stand still until the ball is back


class Plan(nn.Module):
    """Every skill's rows end to end; part of the exported graph."""

    table: Tensor
    knots: Tensor
    back: Tensor
    following: Tensor
    first: Tensor
    last: Tensor
    loop: Tensor
    ready: Tensor
    settle: Tensor
    away: Tensor
    poses: Tensor
    bounce: Tensor
    lowest: Tensor
    offsets: Tensor
    follow: Tensor
    reach: Tensor

    def __init__(self, rows: Sequence[Rows], corrections: Sequence[Correction]) -> None:
        super().__init__()
        self.arms = rows[0].target.shape[1]
        lengths = np.array([len(r.target) for r in rows])
        self.longest = float(max(lengths))
        first = np.cumsum([0, *lengths[:-1]])
        following = np.arange(lengths.sum()) + 1
        for begin, count, r in zip(first, lengths, rows, strict=True):
            following[begin + count - 1] = begin if r.loop else begin + count - 1
        tables = [
            np.concatenate([r.target, r.ball, r.velocity, r.pull[:, None], r.left[:, None]], axis=1) for r in rows
        ]
        self.register_buffer("table", _buffer(np.concatenate(tables)))
        self.register_buffer("knots", _buffer(np.concatenate([r.knots for r in rows])))
        self.register_buffer("back", _buffer(np.concatenate([r.back for r in rows])))
        self.register_buffer("following", torch.tensor(following))
        self.register_buffer("first", _buffer(first[:, None]))
        self.register_buffer("last", _buffer(lengths[:, None] - 1))
        jumps = [max(np.ptp(r.velocity[:, 2]) / GRAVITY, 0.1) if r.loop else 1.0 for r in rows]
        self.register_buffer("bounce", _buffer(np.array(jumps)[:, None]))
        rises = [np.min(r.ball[:, 2] + r.velocity[:, 2] ** 2 / (2 * GRAVITY)) - DEAD for r in rows]
        met = [[height if r.loop and r.left.any() else NEVER] for height, r in zip(rises, rows, strict=True)]
        self.register_buffer("lowest", _buffer(met))  # m that a ball comes up which is not lost to a palm that meets it
        self.register_buffer("loop", _buffer([[r.loop] for r in rows]))
        self.register_buffer("ready", _buffer([[r.ready] for r in rows]))
        self.register_buffer("settle", _buffer([[SETTLE * r.bends] for r in rows]))
        self.register_buffer("away", _buffer(np.concatenate([r.away for r in rows])[:, None]))
        self.register_buffer("poses", _buffer(np.concatenate([r.pose for r in rows])))
        self.register_buffer("offsets", _buffer(np.stack([c.offsets for c in corrections])))
        self.register_buffer("follow", _buffer(np.stack([np.concatenate([c.follow, c.damp]) for c in corrections])))
        self.register_buffer("reach", _buffer(REACH))

    def corrections(self, skill: Tensor) -> tuple[Tensor, Tensor]:
        """Offsets (N, KNOTS, arms) and gains (N, 10) of each robot's skill (N, labels)."""
        offsets = skill @ self.offsets.flatten(1)  # a matrix product: the runtime knows no einsum
        return offsets.unflatten(1, self.offsets.shape[1:]), skill @ self.follow

    def performed(self, skill: Tensor, last_skill: Tensor, last_clock: Tensor, ball: Tensor) -> Tensor:
        """The skill (N, labels) of this tick where ``skill`` is asked for: one whose ball is in the air goes on until that is
        back, unless it is lost."""
        row = self._row(last_skill, last_clock)
        off = ball[:, :3] - self.table[row][:, self.arms : self.arms + 3]
        near = (off * off).sum(dim=-1, keepdim=True) < LOST**2
        stays = last_skill.sum(dim=-1, keepdim=True) * self.away[row] * near.to(ball.dtype)
        return stays * last_skill + (1 - stays) * skill

    def forward(
        self,
        skill: Tensor,
        last_skill: Tensor,
        last_clock: Tensor,
        last_target: Tensor,
        ball: Tensor,
        calm: Tensor,
    ) -> Planned:
        """``skill`` (N, labels) one-hot, and that of the tick before with its clock (N, 1) and targets (N, arms);
        ``ball`` (N, 6) m and m/s in the base; ``calm`` (N, 1) bool: the feet have rested (or are at the right place of
        a stride), without which no ball is let go that is to come back, and no leg bent.
        """
        same = (skill * last_skill).sum(dim=-1, keepdim=True)
        last, loop, ready = skill @ self.last, skill @ self.loop, skill @ self.ready
        clock, rate, lost = self._step(skill, same * last_clock, same, last, loop, ball, calm)
        share = torch.clamp(clock, min=0.0) - torch.clamp(torch.floor(clock), min=0.0)
        row = self._row(skill, clock)
        following = self.following[row]
        mixed = lambda t: t[row] + share * (t[following] - t[row])  # noqa: E731
        planned = mixed(self.table)
        error = ball - planned[:, self.arms : self.arms + 6]
        offsets, gains = self.corrections(skill)
        speed = error[:, 3:]
        place = error[:, :3] + planned[:, self.arms + 7 :] * speed  # where the palm will meet it
        moved = torch.cat([place, place[:, :2], speed, speed[:, :2]], dim=-1) * gains
        waits = (rate <= 0) & (same > 0) & (loop == 0)  # for a ball that is still somewhere else
        wanted = moved[:, : TIPS.stop] + moved[:, TIPS.stop :]
        wanted = torch.where(waits | lost, 0.0, torch.minimum(torch.maximum(wanted, -self.reach), self.reach))
        target = planned[:, : self.arms] + (mixed(self.knots)[:, :, None] * offsets).sum(dim=1)
        target = target + (self.back[row] * wanted[:, None]).sum(dim=-1)
        far = (target - last_target).abs().amax(dim=-1, keepdim=True)
        begin = -far / APPROACH - skill @ self.settle
        clock = torch.where((same == 0) & (ready > 0), begin, clock)  # a ball in the hands comes along
        step = torch.where((clock < 0) | ((clock < 1) & (ready == 0)), APPROACH, AT_ONCE)
        target = last_target + torch.minimum(torch.maximum(target - last_target, -step), step)
        return Planned(target, mixed(self.poses), clock, error, lost)

    def _row(self, skill: Tensor, clock: Tensor) -> Tensor:
        """(N,) rows of the tables at a skill's ``clock`` (N, 1); its first before that has begun."""
        return (skill @ self.first + torch.clamp(torch.floor(clock), min=0.0))[:, 0].to(torch.int64)

    def _step(
        self, skill: Tensor, clock: Tensor, same: Tensor, last: Tensor, loop: Tensor, ball: Tensor, calm: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The clock, moved on, and by how much: a row a tick, and faster or slower as the ball is ahead of its plan or behind;
        and whether the ball is lost.

        A ball that is caught is where the plan has it, sooner or later. One that bounces may never get that high; its
        velocity tells the time, and that jumps back by ``bounce`` s on the floor.
        """
        row = self._row(skill, clock)
        planned = self.table[row][:, self.arms :]
        velocity = planned[:, 3:6]
        along = ((ball[:, :3] - planned[:, :3]) * velocity).sum(-1, keepdim=True)
        fast = (velocity * velocity).sum(-1, keepdim=True)
        along = along / (fast + SLOW**2)
        fallen = (velocity[:, 2:] - ball[:, 5:6]) / GRAVITY
        bounce = skill @ self.bounce
        ahead = torch.where(loop > 0, fallen - bounce * torch.round(fallen / bounce), along)  # s
        rate = torch.clamp(same + planned[:, 6:7] * ahead, 0.0, 2.0)
        # Rows that targets are on their way to, now and then: hands that have begun to open do not stop half-way.
        most = len(self.away) - 1
        after, soon = (row + 1).clamp(max=most), (self._row(skill, clock + rate) + 1).clamp(max=most)
        lets_go = (self.away[after] == 0) & (self.away[soon] > 0)
        settles = (clock < 0) & (skill @ self.settle > 0)
        # Somebody still holds the ball that is to bounce.
        still = (ball[:, 3:] * ball[:, 3:]).sum(-1, keepdim=True) < SLOW**2
        held = (loop > 0) & (clock >= 0) & (clock < 1) & still & (fast > (4 * SLOW) ** 2)
        rises = ball[:, 2:3] + ball[:, 5:6] ** 2 / (2 * GRAVITY)  # m, to where it will
        beside = ((ball[:, :2] - planned[:, :2]) ** 2).sum(-1, keepdim=True) > LOST**2
        lowest = skill @ self.lowest
        lost = ((rises < lowest) | (beside & (lowest > NEVER))) & (clock >= 1)
        rate = torch.where(((lets_go | settles) & ~calm) | held | lost, 0.0, rate)
        moved = clock + rate
        around = moved - (last + 1) * torch.clamp(torch.floor(moved / (last + 1)), min=0.0)
        return torch.where(loop > 0, around, torch.minimum(moved, last)), rate, lost


def document(file: str | Path | None) -> dict[str, dict]:
    """By skill, what ``optimise.py`` wrote into ``file``, seen from the repository's root; nothing before there is one."""
    path = ROOT / (file or "")
    return yaml.safe_load(path.read_text()) if path.is_file() else {}


def read(file: str | Path | None, skills: Sequence[str], arms: int) -> list[Correction]:
    """Of every skill, the corrections in ``file``; none where that says nothing of it. Raises Sim2realError."""
    known = document(file)
    found = []
    for skill in skills:
        entry = known.get(skill, {"offsets": [[0.0] * arms], "follow": 0 * REACH, "damp": 0 * REACH})
        offsets, follow, damp = (np.array(entry[k], float) for k in ("offsets", "follow", "damp"))
        if offsets.shape not in ((1, arms), (KNOTS, arms)) or follow.shape != REACH.shape or damp.shape != REACH.shape:
            raise Sim2realError(
                f"{file}: '{skill}': got offsets {offsets.shape}, follow {follow.shape}, damp {damp.shape}, expected"
                f" (1 or {KNOTS}, {arms}), {REACH.shape}, {REACH.shape}: optimise it again (policies/skillmimic/optimise.py)"
            )
        found.append(Correction(np.broadcast_to(offsets, (KNOTS, arms)), follow, damp))
    return found


def samples(file: str | Path | None, skills: Sequence[str]) -> int:
    """How many policy periods the search for a file's corrections of ``skills`` has simulated."""
    known = document(file)
    return sum(known.get(skill, {}).get("samples", 0) for skill in skills)


def _buffer(values: np.ndarray | list) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)
