"""Adopt: wrap a foreign policy into the contract, so that one runtime plays them all.

A dialect is one module here and one line in ``DIALECTS``. It reads what another stack deploys (network and
configuration) and returns a ``Draft``: the whole graph, the contract's fields, and an independent account, in plain
numpy, of what the other stack's deploy script computes. ``adopt`` records golden sequences from that account, so a
file is written only if our graph agrees with it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from policies.export import SEQUENCES, golden, make_contract, pack
from sim2real.config import RobotConfig, did_you_mean
from sim2real.policy import Policy, PolicyError

if TYPE_CHECKING:
    from onnx import ModelProto

DIALECTS = {  # name -> module with read(source, configs, robot) -> Draft
    "booster_gym": "policies.adopt.booster_gym",
    "holosoma": "policies.adopt.holosoma",
    "playground": "policies.adopt.playground",
    "unitree_rl_gym": "policies.adopt.unitree_rl_gym",
}
STEPS = 40  # of each golden sequence

Step = Callable[[Mapping[str, np.ndarray]], Mapping[str, np.ndarray]]


@dataclass(frozen=True)
class Draft:
    """A foreign policy, understood. ``fields``: the Contract's, less golden. ``start() -> step``: the deploy script."""

    model: ModelProto
    fields: Mapping[str, Any]
    start: Callable[[], Step]


def adopt(
    source: str | Path, dialect: str, robot: RobotConfig, path: str | Path, configs: Sequence[str | Path] = ()
) -> Policy:
    """Wrap the policy at ``source`` (a folder, or a network file) for ``robot`` and write it to ``path``.

    ``configs``: the dialect's configuration files; none: those beside the network. Raises PolicyError.
    """
    if dialect not in DIALECTS:
        raise PolicyError(
            f"adopt: got dialect '{dialect}'{did_you_mean(dialect, DIALECTS)}, expected one of {', '.join(DIALECTS)}"
        )
    source = Path(source)
    if not source.exists():
        raise PolicyError(f"{source}: no such file or folder, expected the network or the folder that holds it")
    draft = importlib.import_module(DIALECTS[dialect]).read(source, [Path(c) for c in configs], robot)
    recorded = []
    for seed in range(SEQUENCES):
        inputs = rehearsal(draft.fields, np.random.default_rng(seed))
        step = draft.start()
        rows = [step({n: v[t] for n, v in inputs.items()}) for t in range(STEPS)]
        recorded.append(golden(inputs, {n: np.stack([r[n] for r in rows]) for n in rows[0]}))
    contract = make_contract({**draft.fields, "golden": recorded}, str(source))
    return pack(draft.model, contract, path, robot)


def rehearsal(fields: Mapping[str, Any], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Inputs like those of a moving robot, each (STEPS, size): joints swing 0.1 rad about the default pose, the base
    sways, the command changes half-way. Signals that nothing here describes are refused by the contract."""
    t = np.arange(STEPS)[:, None] * fields["period"]
    joints = len(fields["joint_names"])
    rate, phase = rng.uniform(2.0, 8.0, joints), rng.uniform(0.0, 2 * np.pi, joints)  # rad/s, rad
    sway = 0.1 * np.sin(rng.uniform(2.0, 6.0, 3) * t + rng.uniform(0.0, 6.0, 3))  # rad
    quaternion = np.concatenate([np.ones((STEPS, 1)), sway / 2], axis=1)
    low, high = np.asarray(fields["command_velocity_min"]), np.asarray(fields["command_velocity_max"])
    command = np.where(t < t[STEPS // 2], rng.uniform(low, high), rng.uniform(low, high))
    signals = {
        "joint_pos": fields["default_joint_pos"] + 0.1 * np.sin(rate * t + phase),
        "joint_vel": 0.1 * rate * np.cos(rate * t + phase),
        "orientation_base_in_world": quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        "angular_velocity_base_in_base": np.gradient(sway, fields["period"], axis=0),
        "command_velocity": command,
    }
    return {n: signals[n].astype(np.float32) for n in fields["inputs"] if n in signals}
