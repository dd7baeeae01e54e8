"""A rig of two motors for any CAN protocol: a bus, its twin in lockstep, and a clock that moves both."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from sim_robots import make_world

from drivers.bus import BusSpec, MotorCommand, MotorSpec, MotorState
from drivers.codecs.mini_cheetah import CYCLE
from drivers.open import PROTOCOLS, open_bus
from drivers.sim.world import World

# Protocol: the model and the identifiers (id, feedback_id) of the motors of the rig.
RIGS: dict[str, tuple[str, list[tuple[int, int]]]] = {
    "damiao": ("DM8006", [(1, 0x11), (2, 0x12)]),
    "robstride": ("RS03", [(1, 0), (0x7F, 0)]),
    "recoil": ("6512", [(1, 0), (63, 0)]),
    "mini_cheetah": ("mini-cheetah", [(1, 0), (0xFF, 0)]),
    "cubemars": ("AK80-9", [(1, 0), (2, 0)]),
    "robstride_mit": ("RS02", [(1, 0), (0x7F, 0)]),
    "odrive": ("D6374-8:1", [(0, 0), (63, 0)]),
    "moteus": ("qdd100-beta2", [(1, 0), (0x7E, 0)]),
}
WATCHDOG = 0.05  # s
FORGETFUL = ("mini_cheetah", "cubemars", "robstride_mit")  # take up the next command as if nothing had been
# Where connecting cannot program it: what the motor was set to before, by serial line or USB.
SET_BEFORE = {
    **{name: {joint: {"TIMEOUT": WATCHDOG / CYCLE} for joint in ("left", "right")} for name in FORGETFUL},
    "odrive": {joint: {"WATCHDOG_TIMEOUT": WATCHDOG} for joint in ("left", "right")},
}
DATA_BITRATES = {"moteus": 5_000_000}  # of those on CAN-FD
RATE = 250.0  # Hz


def rig(protocol: str, **changes: Any) -> BusSpec:
    model, ids = RIGS[protocol]
    motors = tuple(MotorSpec(joint, model, *id) for joint, id in zip(("left", "right"), ids, strict=True))
    return BusSpec(
        **{"name": "arm", "protocol": protocol, "motors": motors}
        | {"watchdog": WATCHDOG * PROTOCOLS[protocol].watchdog, "data_bitrate": DATA_BITRATES.get(protocol, 0)}
        | changes
    )


class WorldClock:
    """Time is the world's: to wait is to let it happen."""

    def __init__(self, world: World) -> None:
        self.world = world

    def now(self) -> float:
        return self.world.time

    def sleep_until(self, time: float) -> None:
        self.world.advance(time)


class Bench:
    """A bus connected to its twin."""

    def __init__(self, folder: Path, protocol: str, connect: bool = True, spec: BusSpec | None = None, **options: Any):
        self.spec = spec or rig(protocol)
        self.world = make_world(folder, bus=self.spec, **options)
        self.bus = open_bus(self.spec, self.world.wires["arm"])
        self.clock = WorldClock(self.world)
        if connect:
            self.bus.connect(self.clock)

    def command(self, **changes: Any) -> MotorCommand:
        zero = {name: np.zeros(2) for name in MotorCommand.__slots__}
        return MotorCommand(**(zero | {k: np.broadcast_to(np.asarray(v, float), 2) for k, v in changes.items()}))

    def tick(self) -> MotorState:
        self.world.advance(self.world.time + 1 / RATE)
        return self.bus.read(self.world.time)

    def enable(self, ticks: int = 20) -> MotorState:
        """As the guardian does: enable and a command without effect, until every motor says that it obeys."""
        for _ in range(ticks):
            self.bus.enable()
            self.bus.write(self.command())
            if (state := self.tick()).enabled.all():
                return state
        raise AssertionError(f"not enabled within {ticks} ticks: {state.enabled}")

    def run(self, seconds: float, **changes: Any) -> MotorState:
        command = self.command(**changes)
        for _ in range(round(seconds * RATE)):
            self.bus.write(command)
            state = self.tick()
        return state

    def poll(self, seconds: float) -> MotorState:
        for _ in range(round(seconds * RATE)):
            self.bus.poll()
            state = self.tick()
        return state

    @property
    def torque(self) -> np.ndarray:
        return self.world.plant.joint_torque.copy()
