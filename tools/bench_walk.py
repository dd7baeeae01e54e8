"""Benchmark: walking policies of other stacks, adopted, through the CAN bytes, against their recorded velocities."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from bench_table import ROOT, Row, deploy, sim2real

from sim2real.types import Sim2realError

SHARED = Path(os.environ.get("SIM2REAL_SHARED", ROOT.parent / "shared"))
SEEDS = range(5)
TOLERANCE = 0.05  # share of the recorded velocity
LOSSY = ["--fault", "drop:0.1"]


class Walk(NamedTuple):
    """A foreign policy under ``shared/policies``: whose, where, and where its velocity is recorded."""

    robot: str
    dialect: str
    source: str
    result: str

    @property
    def name(self) -> str:
        return f"{self.robot} {Path(self.source).stem}"


G1 = Walk("g1", "unitree_rl_gym", "unitree_rl_gym_g1", "unitree_rl_gym_g1/result.json")
WALKS = (
    G1,
    Walk("t1", "holosoma", "holosoma_t1/ppo_t1_29dof.onnx", "holosoma_t1/result_ppo.json"),
    Walk("t1", "holosoma", "holosoma_t1/fastsac_t1_29dof.onnx", "holosoma_t1/result_fastsac.json"),
    Walk("t1", "booster_gym", "booster_gym_t1", "booster_gym_t1/result.json"),
    Walk("t1", "playground", "playground_t1", "playground_t1/result.json"),
)


def rows() -> Iterator[Row]:
    """Every seed of every walk on a clean bus, and of the G1's on a lossy one."""
    for walk in WALKS:
        yield row(walk)
    yield row(G1, LOSSY)


def row(walk: Walk, faults: Sequence[str] = ()) -> Row:
    """One walk on every seed."""
    recorded = json.loads((SHARED / "policies" / walk.result).read_text())["runs"]["forward_0.5"][
        "mean_vx_body_after2s"
    ]
    there = ["--policy", adopted(walk), "--skill", "walk", "--velocity", 0.5, 0, 0, "--duration", 20]
    runs = [deploy(*there, "--clock", "lockstep", "--seed", seed, *faults, robot=walk.robot) for seed in SEEDS]
    falls = sum(run["fell"] or bool(run["faults"]) for run in runs)
    velocities = [run["mean_velocity"][0] if run["mean_velocity"] else 0.0 for run in runs]
    off = max(abs(v / recorded - 1) for v in velocities)
    return Row(
        f"adopted {walk.name}, 0.5 m/s for 20 s through CAN, {len(runs)} seeds"
        + (", 10 % of frames dropped" if faults else ""),
        f"{np.mean(velocities):.3f} m/s, {falls} of {len(runs)} fell or stopped",
        f"{recorded:.3f} m/s in its own simulation",
        f"{np.mean(velocities) / recorded - 1:+.1%}, one seed {off:.1%} off",
        "none falls" if faults else f"none falls, each within {TOLERANCE:.0%}",
        falls == 0 and (bool(faults) or off <= TOLERANCE),
        {"velocities": velocities, "recorded": recorded, "falls": falls},
    )


def standing(seconds: float) -> list[object]:
    """Arguments of ``sim2real deploy`` for a run that stays where it is: the shipped policy, or else the adopted one."""
    if (ROOT / "policies" / "g1" / "basics.onnx").is_file():
        return ["--skill", "stand", "--duration", seconds]
    return ["--policy", adopted(G1), "--skill", "walk", "--duration", seconds]


def adopted(walk: Walk) -> Path:
    """The foreign policy under our contract. Raises Sim2realError where its source is not at hand."""
    source, path = SHARED / "policies" / walk.source, ROOT / "runs" / "bench" / f"{walk.name.replace(' ', '_')}.onnx"
    if not source.exists():
        raise Sim2realError(f"no foreign policy at {source}; set SIM2REAL_SHARED to the folder of reference material")
    path.parent.mkdir(parents=True, exist_ok=True)
    sim2real("adopt", source, "--dialect", walk.dialect, "--robot", walk.robot, "-o", path)
    return path
