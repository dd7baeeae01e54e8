"""The world process of a simulated real-time run: the robot's body, its motors and buses, behind sockets."""

from __future__ import annotations

import contextlib
import socket
import sys
from pathlib import Path

from sim2real.clock import MonotonicClock, tune
from sim2real.object.camera import SIGHTS, SimCamera
from sim2real.object.scene import prepare_for
from sim2real.run import Life, RunSpec, tell

PRIORITY = 60  # below the guardian's and the pilot's; on whichever CPU they leave free


def main(directory: Path) -> int:
    """Serve the world of the run in ``directory`` until the launcher goes."""
    from drivers.open import open_world
    from drivers.sim.serve import serve
    from sim2real.simulation import SETTLE

    timestep = 0.002
    life = Life()
    spec = RunSpec.load(directory)
    config, wiring = spec.open()
    world = open_world(
        config.model_path,
        config.base,
        wiring.bus_specs(),
        wiring.imu_spec(),
        timestep=timestep,
        seed=spec.seed,
        faults=spec.faults,
        prepare=prepare_for(spec.object, timestep),
        joint_pos=dict(zip(config.joint_names, config.home_pos, strict=True)),
    )
    world.advance(SETTLE)
    if spec.tune:  # real motors do not wait for other programs either
        tune(PRIORITY, spin=0.0)
    camera = SimCamera(SIGHTS[spec.sight], spec.seed) if spec.camera else None
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.setblocking(False)
    said = False

    def look() -> None:
        """The camera sees, and its computer sends. A receiver that is gone or slow costs nothing."""
        if camera is None or spec.camera is None:
            return
        now = MonotonicClock.now()  # the world keeps to it
        camera.watch(world, now)
        for datagram in camera.sent(now):
            with contextlib.suppress(OSError):
                wire.sendto(datagram, spec.camera)

    def goes_on() -> bool:
        nonlocal said
        look()
        if not said:  # only now does anybody listen
            tell("ready", ready=True)
            said = True
        return life.goes_on()

    serve(world, directory, goes_on=goes_on, warn=tell)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
