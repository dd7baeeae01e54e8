"""Two small bodies for tests of the simulated twin, and a host that speaks raw frames to their motors."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drivers.bus import BusSpec, ImuSpec, MotorSpec
from drivers.sim.world import World
from drivers.wire import FRAME, make_frames

# Two joints with upright axes, so that gravity does nothing, each turning 0.02 kg m^2 and nothing else.
ARM = """
<mujoco>
  <worldbody>
    <body name="base">
      <site name="imu" pos="0 0 0.1"/>
      <geom type="sphere" size="0.05" mass="1"/>
      <body pos="1 0 0">
        <joint name="left" axis="0 0 1" armature="0.019" actuatorfrcrange="-30 30"/>
        <geom type="sphere" size="0.05" mass="1" contype="0" conaffinity="0"/>
      </body>
      <body pos="-1 0 0">
        <joint name="right" axis="0 0 1" armature="0.019" actuatorfrcrange="-30 30"/>
        <geom type="sphere" size="0.05" mass="1" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="left"/></actuator>
  <keyframe><key ctrl="1"/></keyframe>
</mujoco>
"""
ARM_INERTIA = 0.019 + 0.4 * 1 * 0.05**2  # kg m^2, of either joint

# A box of 10 kg on two short legs.
BOX = """
<mujoco>
  <worldbody>
    <body name="base" pos="0 0 1">
      <freejoint/>
      <site name="imu" pos="0 0 0.1"/>
      <geom type="box" size="0.1 0.1 0.2" mass="8"/>
      <body pos="0 0.1 -0.2">
        <joint name="left" axis="0 1 0" range="-1 1"/>
        <geom type="box" size="0.1 0.04 0.05" pos="0 0 -0.05" mass="1"/>
      </body>
      <body pos="0 -0.1 -0.2">
        <joint name="right" axis="0 1 0" range="-1 1"/>
        <geom type="box" size="0.1 0.04 0.05" pos="0 0 -0.05" mass="1"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
MOTORS = (MotorSpec("left", "DM8006", 1, 0x11), MotorSpec("right", "DM8006", 2, 0x12))
BUS = BusSpec("arm", "damiao", MOTORS)
IMU = ImuSpec("hipnuc", rate=500.0)

ENABLE, DISABLE, SET_ZERO, CLEAR = (b"\xff" * 7 + bytes([last]) for last in (0xFC, 0xFD, 0xFE, 0xFB))
# 0x7FF [id, 0, 0xCC, ...]: what is your state?
REFRESH = bytes([1, 0, 0xCC, 0, 0, 0, 0, 0])


def write_model(folder: Path, text: str = ARM) -> Path:
    path = folder / "robot.xml"
    path.write_text(text)
    return path


def make_world(folder: Path, model: str = ARM, bus: BusSpec = BUS, imu: ImuSpec = IMU, **options) -> World:
    options.setdefault("hang", None)
    return World(write_model(folder, model), "base", [bus], imu, **options)


class Host:
    """Sends raw payloads on one bus of a world and lets time pass."""

    def __init__(self, world: World, bus: str = "arm"):
        self.world, self.wire = world, world.wires[bus]

    def send(self, *frames: tuple[int, bytes]) -> None:
        ids = np.array([id for id, _ in frames], np.uint32)
        self.wire.send(make_frames(ids, np.array([list(data) for _, data in frames], np.uint8)))

    def wait(self, seconds: float) -> np.ndarray:
        self.world.advance(self.world.time + seconds)
        return self.wire.recv()

    def ask(self, id: int, data: bytes) -> list[tuple[int, str]]:
        """Every answer within 4 ms, as (identifier, hex)."""
        self.send((id, data))
        return answers(self.wait(0.004))

    def command(self, position=0.0, velocity=0.0, kp=0.0, kd=0.0, torque=0.0, ids=(1, 2)) -> None:
        """The same MIT command to both motors (or to ``ids``), packed the plain way from the manual's formula."""
        self.send(*[(id, mit(position, velocity, kp, kd, torque)) for id in ids])


def mit(position: float, velocity: float, kp: float, kd: float, torque: float, full=(12.5, 45.0, 40.0)) -> bytes:
    """An MIT command for a DM8006, one bit field after the other."""
    p, v, t = full
    fields = [(position, -p, p, 16), (velocity, -v, v, 12), (kp, 0, 500, 12), (kd, 0, 5, 12), (torque, -t, t, 12)]
    word = 0
    for x, low, high, bits in fields:
        word = word << bits | round((x - low) / (high - low) * (2**bits - 1))
    return word.to_bytes(8, "big")


def answers(frames: np.ndarray) -> list[tuple[int, str]]:
    assert frames.dtype == FRAME
    return [(int(f["id"]), f["data"].tobytes().hex(" ")) for f in frames]
