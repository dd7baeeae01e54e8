"""Write the policy that holds a robot's home posture: the first to run on a new body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from sim2real.config import load_robot
from sim2real.options import NewFile
from sim2real.types import Sim2realError


@dataclass
class Args:
    """Write the policy that holds a robot's home posture.

    It looks at nothing and does not balance, but everything around it is that of any other policy: a soft start to the
    home of the robot's YAML, the gate, the wires, the record. Run it on the gantry first.
    """

    robot: str
    """a robot of configs/robots, or the path of a YAML"""
    output: Annotated[NewFile, tyro.conf.arg(aliases=["-o"])]
    """policy file to write (.onnx)"""


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real posture", description=__doc__)
    config = load_robot(args.robot)
    from sim2real.policy import load_policy
    from sim2real.posture import write_posture

    try:
        write_posture(config, args.output)
    except OSError as error:
        raise Sim2realError(f"{args.output}: {error.strerror}; expected a file that can be written") from None
    policy = load_policy(args.output, config)
    print(
        f"{args.output}: '{policy.contract.name}' for {config.name}, {len(config.joint_names)} joints at "
        f"{1 / policy.contract.period:g} Hz\n  sha256 {policy.sha256}\n"
        f"  next: sim2real deploy --robot {args.robot} --policy {args.output} --clock lockstep --hang"
    )
    return 0
