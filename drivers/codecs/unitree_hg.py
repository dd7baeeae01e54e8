"""Unitree `hg` LowCmd and LowState (G1): bytes to SI and back, host side and robot side.

A message has two layouts. Its CRC is over the C struct; on the wire is CDR (XCDR1, little-endian, behind a header of four
bytes). They differ in one place: CDR pads less, so that motor 0's ``mode`` slips back into what is padding in the struct.

    LowCmd    struct 1004: mode_pr 0, mode_machine 1, motor i at 4 + 28 i, reserve 984, crc 1000
              CDR    1000: mode_pr 0, mode_machine 1, mode of motor 0 at 2, and from 4 on the struct from 8 on
    LowState  struct 2092: version 0, mode_pr 8, mode_machine 9, tick 12, IMU 16, motor i at 72 + 56 i, remote 2032,
                           reserve 2072, crc 2088
              CDR    2088: the struct to 70, mode of motor 0 at 70, and from 72 on the struct from 76 on

Both hold 35 motors, of which a G1 has 29. ``MotorSpec.id`` is the index, ``MotorSpec.model`` what the maker put there,
which ``mode_machine`` tells: a robot of another variant is refused joint by joint, for its limits and gains differ.

Sources: unitree_sdk2 (IDL, CRC), unitree_ros g1_description (variants, 2026-06-18), Unitree's G1 documents (motorstate).
Not verified on a robot: that LowState's ``mode`` says whether a motor is enabled. If it does not, arming is refused.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drivers.bus import BusError, BusSpec, MotorCommand, MotorState

COMMAND_TOPIC, STATE_TOPIC = "rt/lowcmd", "rt/lowstate"
SLOTS = 35  # motors in a message
CDR_HEADER = bytes([0, 1, 0, 0])  # XCDR1, little-endian
SERIES_JOINTS = 0  # mode_pr: ankles and waist as pitch and roll joints; 1: as their two motors
ENABLED = 1  # mode of a motor

_COMMAND_MOTOR = np.dtype(
    {
        "names": ["mode", "q", "dq", "tau", "kp", "kd", "reserve"],
        "formats": ["u1", "<f4", "<f4", "<f4", "<f4", "<f4", "<u4"],
        "offsets": [0, 4, 8, 12, 16, 20, 24],
        "itemsize": 28,
    }
)
COMMAND = np.dtype(
    {
        "names": ["mode_pr", "mode_machine", "motors", "reserve", "crc"],
        "formats": ["u1", "u1", (_COMMAND_MOTOR, SLOTS), ("<u4", 4), "<u4"],
        "offsets": [0, 1, 4, 984, 1000],
        "itemsize": 1004,
    }
)
_STATE_MOTOR = np.dtype(
    {
        "names": ["mode", "q", "dq", "ddq", "tau", "temperature", "voltage", "sensor", "error", "reserve"],
        "formats": ["u1", "<f4", "<f4", "<f4", "<f4", ("<i2", 2), "<f4", ("<u4", 2), "<u4", ("<u4", 4)],
        "offsets": [0, 4, 8, 12, 16, 20, 24, 28, 36, 40],
        "itemsize": 56,
    }
)
STATE = np.dtype(
    {
        "names": ["version", "mode_pr", "mode_machine", "tick", "orientation", "angular_velocity", "acceleration", "rpy",
                  "imu_temperature", "motors", "remote", "reserve", "crc"],
        "formats": [("<u4", 2), "u1", "u1", "<u4", ("<f4", 4), ("<f4", 3), ("<f4", 3), ("<f4", 3), "<i2",
                    (_STATE_MOTOR, SLOTS), ("u1", 40), ("<u4", 4), "<u4"],
        "offsets": [0, 8, 9, 12, 16, 32, 44, 56, 68, 72, 2032, 2072, 2088],
        "itemsize": 2092,
    }
)  # fmt: skip
COMMAND_SIZE = len(CDR_HEADER) + COMMAND.itemsize - 4  # bytes of a payload
STATE_SIZE = len(CDR_HEADER) + STATE.itemsize - 4
_PADDED_WORDS = [2, *range(18, 18 + 14 * SLOTS, 14)]  # of a LowState struct, where modes are followed by padding

# motorstate: the bits that the G1 documents name; the list is known to be incomplete, and any bit is an error.
ERRORS: dict[int, str] = {
    0x1: "over-current",
    0x2: "transient over-voltage",
    0x4: "sustained over-voltage",
    0x8: "under-voltage",
    0x10: "chip over-temperature",
    0x20: "MOS over-temperature",
    0x80: "shell over-temperature",
    0x200: "winding over-temperature",
    0x400: "rotor encoder",
    0x800: "rotor encoder",
    0x1000: "output encoder",
    0x8000: "locked",
}

JOINTS = (
    "left_hip_pitch", "left_hip_roll", "left_hip_yaw", "left_knee", "left_ankle_pitch", "left_ankle_roll",
    "right_hip_pitch", "right_hip_roll", "right_hip_yaw", "right_knee", "right_ankle_pitch", "right_ankle_roll",
    "waist_yaw", "waist_roll", "waist_pitch",
    "left_shoulder_pitch", "left_shoulder_roll", "left_shoulder_yaw", "left_elbow",
    "left_wrist_roll", "left_wrist_pitch", "left_wrist_yaw",
    "right_shoulder_pitch", "right_shoulder_roll", "right_shoulder_yaw", "right_elbow",
    "right_wrist_roll", "right_wrist_pitch", "right_wrist_yaw",
)  # fmt: skip


class Model(NamedTuple):
    """A motor at its joint: the most it gives (N m) and turns (rad/s)."""

    torque: float
    velocity: float


# Named by the size of their rotor and their gear. The maker's URDF says 35 N m for the pairs of 5020, its MJCF 50.
MODELS: dict[str, Model] = {
    "M7520-14": Model(88, 32),
    "M7520-22": Model(139, 20),
    "M5020x2": Model(50, 30),
    "M5020": Model(25, 37),
    "M4010": Model(5, 22),
    "M5010": Model(13.4, 27),
}


class Variant(NamedTuple):
    """What a ``mode_machine`` stands for: where variants differ, which motor they have, and the slots without one."""

    description: str
    hip_pitch: str
    hip_roll: str
    wrist: str  # pitch and yaw
    absent: frozenset[int] = frozenset()


LOCKED_WAIST = frozenset({13, 14})
SHORT = frozenset({13, 14, 20, 21, 27, 28})  # 23 joints
ARMS = frozenset(range(15))  # no legs and no waist

VARIANTS: dict[int, Variant] = {
    1: Variant("g1_23dof, deprecated", "M7520-14", "M7520-14", "M4010", SHORT),
    2: Variant("g1_29dof, deprecated", "M7520-14", "M7520-14", "M4010"),
    3: Variant("g1_29dof_lock_waist, deprecated", "M7520-14", "M7520-14", "M4010", LOCKED_WAIST),
    4: Variant("g1_23dof_rev_1_0", "M7520-14", "M7520-22", "M4010", SHORT),
    5: Variant("g1_29dof_rev_1_0", "M7520-14", "M7520-22", "M4010"),
    6: Variant("g1_29dof_lock_waist_rev_1_0", "M7520-14", "M7520-22", "M4010", LOCKED_WAIST),
    9: Variant("g1_dual_arm", "", "", "M4010", ARMS),
    10: Variant("g1_23dof_mode_10", "M7520-22", "M7520-22", "M4010", SHORT),
    11: Variant("g1_29dof_mode_11", "M7520-22", "M7520-22", "M4010"),
    12: Variant("g1_29dof_mode_12", "M7520-22", "M7520-22", "M4010", LOCKED_WAIST),
    13: Variant("g1_29dof_mode_13", "M7520-14", "M7520-22", "M5010"),
    14: Variant("g1_29dof_mode_14", "M7520-14", "M7520-22", "M5010", LOCKED_WAIST),
    15: Variant("g1_29dof_mode_15", "M7520-22", "M7520-22", "M5010"),
    16: Variant("g1_29dof_mode_16", "M7520-22", "M7520-22", "M5010", LOCKED_WAIST),
}


def models_of(variant: Variant) -> tuple[str, ...]:
    """The motor at each of JOINTS (29,); "" where there is none."""
    leg = (variant.hip_pitch, variant.hip_roll, "M7520-14", "M7520-22", "M5020x2", "M5020x2")
    arm = ("M5020",) * 5 + (variant.wrist,) * 2
    models = (*leg, *leg, "M7520-14", "M5020x2", "M5020x2", *arm, *arm)
    return tuple("" if i in variant.absent else model for i, model in enumerate(models))


_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def crc32(words: np.ndarray) -> int:
    """CRC of ``words`` (n,) little-endian uint32: polynomial 0x04C11DB7, start 0xFFFFFFFF, the high bit of each word
    first, nothing reflected, no final exclusive or.

    zlib's is the mirror image of that, so its tables serve with every word mirrored on the way in and out.
    """
    mirrored = zlib.crc32(words.byteswap().tobytes().translate(_REVERSED)) ^ 0xFFFF_FFFF
    return int.from_bytes(mirrored.to_bytes(4, "little").translate(_REVERSED), "big")


def command_payload(words: np.ndarray) -> bytes:
    """A LowCmd struct as words (251,) uint32, sealed with its CRC, as CDR (COMMAND_SIZE bytes)."""
    words[-1] = crc32(words[:-1])
    struct = words.tobytes()
    return b"".join((CDR_HEADER, struct[:2], struct[4:5], b"\0", struct[8:]))


def read_command(payload: bytes) -> np.ndarray | None:
    """The LowCmd (COMMAND, shape (1,)) in a CDR payload; None if its header, length or CRC is wrong."""
    if len(payload) != COMMAND_SIZE or payload[:4] != CDR_HEADER:
        return None
    words = np.frombuffer(payload[4:6] + b"\0\0" + payload[6:7] + b"\0\0\0" + payload[8:], "<u4").copy()
    words[1:-6:7] &= 0xFF  # what the sender left in the padding is not in its CRC
    return words.view(COMMAND) if crc32(words[:-1]) == words[-1] else None


def state_payload(words: np.ndarray) -> bytes:
    """A LowState struct as words (523,) uint32, sealed with its CRC, as CDR (STATE_SIZE bytes)."""
    words[-1] = crc32(words[:-1])
    struct = words.tobytes()
    return b"".join((CDR_HEADER, struct[:70], struct[72:73], b"\0", struct[76:]))


def read_state(payload: bytes) -> np.ndarray | None:
    """The LowState (STATE, shape (1,)) in a CDR payload; None if its header, length or CRC is wrong."""
    if len(payload) != STATE_SIZE or payload[:4] != CDR_HEADER:
        return None
    words = np.frombuffer(payload[4:74] + b"\0\0" + payload[74:75] + b"\0\0\0" + payload[76:], "<u4").copy()
    words[_PADDED_WORDS] &= _PADDING_MASK
    return words.view(STATE) if crc32(words[:-1]) == words[-1] else None


_PADDING_MASK = np.array([0xFFFF] + [0xFF] * SLOTS, np.uint32)


class UnitreeHgCodec:
    """The host's side: LowCmd for the motors of one bus, and what a LowState says of them."""

    # Bits on the Ethernet: a LowCmd (1004 bytes) and a LowState (2092, in two packets), with RTPS, UDP, IP and Ethernet
    # around them (about 150 bytes a packet). However many motors are used, all 35 slots are there.
    TICK_BITS = (0.0, 0.0)
    TICK_OVERHEAD_BITS = (1004 + 2092 + 3 * 150) * 8.0
    TICK_FRAMES = 2  # one sample each way

    def __init__(self, spec: BusSpec) -> None:
        """Raises BusError for a slot or a model that no G1 has, or a joint in another's slot."""
        _check_slots(spec)
        self._spec = spec
        ids = [m.id for m in spec.motors]
        n = len(ids)
        self._at = slice(0, n) if ids == list(range(n)) else np.array(ids)
        self._words = np.zeros(COMMAND.itemsize // 4, "<u4")
        self._frame = self._words.view(COMMAND)
        motors = self._frame["motors"][0]
        self._modes = motors["mode"]
        self._fields = [motors[name] for name in ("q", "dq", "tau", "kp", "kd")]
        self._values = self._words[1:-5].view("<f4").reshape(SLOTS, -1)[:, 1:6]

    def pack_command(self, command: MotorCommand, mode_machine: int) -> bytes:
        """A LowCmd (COMMAND_SIZE bytes) that enables every motor of the bus. Raises ValueError for a value that is not
        finite, or not in single precision."""
        self._clear(mode_machine)
        c = command
        with np.errstate(over="ignore"):
            for field, values in zip(self._fields, (c.position, c.velocity, c.torque, c.kp, c.kd), strict=True):
                field[self._at] = values
        if not np.isfinite(self._values).all():
            bad = [m.joint for m in self._spec.motors if not np.isfinite(self._values[m.id]).all()]
            raise ValueError(f"bus {self._spec.name}: command of {', '.join(bad)}: expected finite values")
        self._modes[self._at] = ENABLED
        return command_payload(self._words)

    def pack_enable(self, mode_machine: int) -> bytes:
        """A LowCmd that enables every motor without torque: all gains zero."""
        self._clear(mode_machine)
        self._modes[self._at] = ENABLED
        return command_payload(self._words)

    def pack_disable(self, mode_machine: int) -> bytes:
        """A LowCmd that disables every motor."""
        self._clear(mode_machine)
        return command_payload(self._words)

    def _clear(self, mode_machine: int) -> None:
        """Every frame starts from zeros, so that nothing of the last one can stay."""
        self._words[:] = 0
        self._frame["mode_pr"] = SERIES_JOINTS
        self._frame["mode_machine"] = mode_machine

    def unpack(self, sample: np.ndarray, state: MotorState, now: float) -> bool:
        """Put a LowState (STATE, (1,)) into ``state``. Returns False, and leaves it old, where a number in it is not
        finite."""
        motors = sample["motors"][0][self._at]
        values = np.stack([motors["q"], motors["dq"], motors["tau"]])
        if not np.isfinite(values).all():
            return False
        state.position[:], state.velocity[:], state.torque[:] = values
        state.temperature[:] = motors["temperature"].max(axis=1)
        state.error[:] = motors["error"]
        state.enabled[:] = motors["mode"] == ENABLED
        state.time[:] = now
        return True

    def misfits(self, mode_machine: int) -> list[str]:
        """Where a robot of that variant differs from the wiring: one line for each motor; empty: it fits."""
        if mode_machine not in VARIANTS:
            return [f"mode_machine {mode_machine} is no variant known here"]
        models = models_of(VARIANTS[mode_machine])
        return [
            f"{m.joint}: the robot has {_named(models[m.id])}, the wiring {_named(m.model)}"
            for m in self._spec.motors
            if models[m.id] != m.model
        ]

    def error_name(self, code: int) -> str:
        if not code:
            return "none"
        known = list(dict.fromkeys(name for bit, name in ERRORS.items() if code & bit))
        rest = code & ~sum(ERRORS)
        return " + ".join([*known, *([f"unknown {rest:#x}"] if rest else [])])


def _named(model: str) -> str:
    return f"a {model} ({MODELS[model].torque:g} N m, {MODELS[model].velocity:g} rad/s)" if model else "no motor"


def _check_slots(spec: BusSpec) -> None:
    for m in spec.motors:
        where = f"bus {spec.name}, motor of {m.joint}"
        if m.id >= len(JOINTS):
            raise BusError(f"{where}: got id {m.id}, expected 0 to {len(JOINTS) - 1}, its slot in LowCmd")
        if not m.joint.startswith(JOINTS[m.id]):
            raise BusError(f"{where}: got id {m.id}, which is the slot of {JOINTS[m.id]}; expected the joint's own")
        if m.model not in MODELS:
            raise BusError(f"{where}: no motor '{m.model}' in a G1; known: {', '.join(MODELS)}")


class ImuSample(NamedTuple):
    """What a LowState says of the pelvis IMU, in SI units and its own frame."""

    orientation: np.ndarray  # (4,) w, x, y, z
    angular_velocity: np.ndarray  # (3,) rad/s
    acceleration: np.ndarray  # (3,) m/s^2


class ImuParser:
    """The IMU in a stream of LowState payloads, one behind the other (a drivers.imu.serial.ImuParser)."""

    def __init__(self) -> None:
        self.rejected = 0
        self._tick = -1

    def feed(self, data: bytes) -> list[ImuSample]:
        """Every new sample in whole payloads. One that repeats the last ``tick`` is not new, and rejected."""
        samples = []
        for at in range(0, len(data), STATE_SIZE):
            sample = read_state(data[at : at + STATE_SIZE])
            if sample is None or (tick := int(sample["tick"][0])) == self._tick:
                self.rejected += 1
                continue
            self._tick = tick
            samples.append(
                ImuSample(*(sample[f][0].astype(float) for f in ("orientation", "angular_velocity", "acceleration")))
            )
        return samples


class Remote(NamedTuple):
    """The wireless remote: sticks from -1 to 1, right and up positive, and the buttons that are down."""

    left: tuple[float, float]
    right: tuple[float, float]
    buttons: frozenset[str]


BUTTONS = ("R1", "L1", "start", "select", "R2", "L2", "F1", "F2", "A", "B", "X", "Y", "up", "right", "down", "left")


def read_remote(remote: np.ndarray) -> Remote:
    """LowState's ``remote`` (40,) uint8: two bytes of buttons at 2; as floats left x at 4, right x 8, right y 12, left y
    20. Source: unitree_sdk2, gamepad of the G1 examples."""
    data = remote.tobytes()
    keys = int.from_bytes(data[2:4], "little")
    lx, rx, ry, _, ly = np.frombuffer(data, "<f4", 5, 4).tolist()
    return Remote((lx, ly), (rx, ry), frozenset(name for bit, name in enumerate(BUTTONS) if keys >> bit & 1))


def pack_state(motors: Sequence[np.ndarray], imu: Sequence[np.ndarray], tick: int, mode_machine: int) -> bytes:
    """The robot's side: a LowState (STATE_SIZE bytes).

    ``motors``: mode, rad, rad/s, N m, deg C, motorstate of the first n motors, (n,) each; ``imu``: quaternion (w, x, y,
    z), rad/s, m/s^2; ``tick`` ms.
    """
    words = np.zeros(STATE.itemsize // 4, "<u4")
    frame = words.view(STATE)
    frame["mode_machine"], frame["tick"] = mode_machine, tick & 0xFFFF_FFFF
    n = len(motors[0])
    slots = frame["motors"][0]
    for name, values in zip(("mode", "q", "dq", "tau", "temperature", "error"), motors, strict=True):
        slots[name][:n] = values[:, None] if name == "temperature" else values
    for name, values in zip(("orientation", "angular_velocity", "acceleration"), imu, strict=True):
        frame[name][0] = values
    return state_payload(words)
