"""The simplest policy there is: it looks at nothing and holds a robot's home posture with the gains of its YAML.

It is the first thing to run on a new body: soft start, gate, wires and recorder are those of any other policy. It does not
balance. A robot stands with it as far as its feet, its weight and its gains do so by themselves; else leave it on its gantry.
"""

from __future__ import annotations

import json
from pathlib import Path

from sim2real.config import RobotConfig
from sim2real.contract import METADATA_KEY, Contract, Golden, Provenance, Skill
from sim2real.graph import sealed_constant

RATE = 50.0  # Hz, or the nearest that is a whole number of the wiring's ticks
STEPS = 5  # of the golden sequence


def write_posture(config: RobotConfig, path: Path) -> None:
    """Write it for ``config``: one skill, ``home``. The same robot gives the same bytes, on any machine."""
    document = json.dumps(contract_of(config).model_dump(mode="json"))
    path.write_bytes(sealed_constant("joint_pos_target", config.home_pos.tolist(), {METADATA_KEY: document}))


def contract_of(config: RobotConfig) -> Contract:
    """What that policy says about itself."""
    rate = config.wiring().rate
    home, names = config.home_pos.tolist(), list(config.joint_names)
    return Contract(
        name="posture",
        robot=config.name,
        variants=config.variants,
        period=max(1, round(rate / RATE)) / rate,
        joint_names=names,
        target_joint_names=names,
        default_joint_pos=home,
        kp=config.home_kp.tolist(),
        kd=config.home_kd.tolist(),
        inputs={},
        outputs={"joint_pos_target": [len(names)]},
        skills=[Skill(label="home", description="Holds the home posture; does not balance")],
        default_skill="home",
        golden=[Golden(steps=STEPS, inputs={}, outputs={"joint_pos_target": [home] * STEPS})],
        provenance=Provenance(source=f"sim2real posture, from home of {config.name}.yaml", licence="Apache-2.0"),
    )
