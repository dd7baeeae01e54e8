"""Benchmark: a walking policy of another stack, adopted, through the CAN bytes, against its recorded velocity."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from bench_table import ROOT, Row, deploy, sim2real

from sim2real.types import Sim2realError

SHARED = Path(os.environ.get("SIM2REAL_SHARED", ROOT.parent / "shared"))
SOURCE = SHARED / "policies" / "unitree_rl_gym_g1"
SEEDS = range(5)
TOLERANCE = 0.05  # share of the recorded velocity
CONDITIONS = {"": [], ", 10 % of frames dropped": ["--fault", "drop:0.1"]}


def rows() -> Iterator[Row]:
    """Every seed, on a clean bus and on a lossy one."""
    policy = adopted()
    recorded = json.loads((SOURCE / "result.json").read_text())["runs"]["forward_0.5"]["mean_vx_body_after2s"]
    walk = ["--policy", policy, "--skill", "walk", "--velocity", 0.5, 0, 0, "--duration", 20, "--clock", "lockstep"]
    for words, faults in CONDITIONS.items():
        runs = [deploy(*walk, "--seed", seed, *faults) for seed in SEEDS]
        falls = sum(run["fell"] or bool(run["faults"]) for run in runs)
        velocities = [run["mean_velocity"][0] if run["mean_velocity"] else 0.0 for run in runs]
        off = max(abs(v / recorded - 1) for v in velocities)
        yield Row(
            f"adopted walk, 0.5 m/s for 20 s through CAN, {len(runs)} seeds{words}",
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
    return ["--policy", adopted(), "--skill", "walk", "--duration", seconds]


def adopted() -> Path:
    """The foreign policy under our contract. Raises Sim2realError where its source is not at hand."""
    path = ROOT / "runs" / "bench" / "walk.onnx"
    if not SOURCE.is_dir():
        raise Sim2realError(f"no foreign policy at {SOURCE}; set SIM2REAL_SHARED to the folder of reference material")
    path.parent.mkdir(parents=True, exist_ok=True)
    sim2real("adopt", SOURCE, "--dialect", "unitree_rl_gym", "--robot", "g1", "-o", path)
    return path
