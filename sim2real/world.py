"""The world process of a simulated real-time run: the robot's body, its motors and buses, behind sockets."""

from __future__ import annotations

import sys
from pathlib import Path

from sim2real.run import Life, RunSpec, tell


def main(directory: Path) -> int:
    """Serve the world of the run in ``directory`` until the launcher goes."""
    from drivers.sim.serve import serve
    from drivers.sim.world import World
    from sim2real.simulation import SETTLE

    life = Life()
    spec = RunSpec.load(directory)
    config, wiring = spec.open()
    world = World(
        config.model_path,
        config.base,
        wiring.bus_specs(),
        wiring.imu_spec(),
        seed=spec.seed,
        faults=spec.faults,
        joint_pos=dict(zip(config.joint_names, config.home_pos, strict=True)),
    )
    world.advance(SETTLE)
    serve(world, directory, ready=lambda: tell("ready", ready=True), goes_on=life.goes_on, warn=tell)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
