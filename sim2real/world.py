"""The world process of a simulated real-time run: the robot's body, its motors and buses, behind sockets."""

from __future__ import annotations

import sys
from pathlib import Path

from sim2real.clock import tune
from sim2real.run import Life, RunSpec, tell

PRIORITY = 60  # below the guardian's and the pilot's; on whichever CPU they leave free


def main(directory: Path) -> int:
    """Serve the world of the run in ``directory`` until the launcher goes."""
    from drivers.open import open_world
    from drivers.sim.serve import serve
    from sim2real.simulation import SETTLE

    life = Life()
    spec = RunSpec.load(directory)
    config, wiring = spec.open()
    world = open_world(
        config.model_path,
        config.base,
        wiring.bus_specs(),
        wiring.imu_spec(),
        seed=spec.seed,
        faults=spec.faults,
        joint_pos=dict(zip(config.joint_names, config.home_pos, strict=True)),
    )
    world.advance(SETTLE)
    if spec.tune:  # real motors do not wait for other programs either
        tune(PRIORITY, spin=0.0)
    said = False

    def goes_on() -> bool:
        nonlocal said
        if not said:  # only now does anybody listen
            tell("ready", ready=True)
            said = True
        return life.goes_on()

    serve(world, directory, goes_on=goes_on, warn=tell)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
