"""MIT-mode frames (the mini-cheetah packing, firmware bgkatz/motorcontrol), a whole bus per call, both sides.

A command is one big-endian 64-bit word, MSB first: position 16 bits, velocity 12, kp 12, kd 12, torque 12.
A reply is: one byte of the vendor's (motor id, often with an error nibble), position 16, velocity 12, torque 12, two bytes
of the vendor's (temperatures, error or nothing). Codes are linear over the range of each quantity:

    code = trunc((x - low) (2^bits - 1) / (high - low))        x = low + code (high - low) / (2^bits - 1)

``2^bits - 1`` is odd, so that zero lies between two codes and is sent as the lower one (half a code below zero).
The ranges are settings of each motor, not constants of the protocol: read them back before trusting them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drivers.bus import MotorCommand

QUANTITIES = ("position", "velocity", "kp", "kd", "torque")

# Where each quantity sits in the 64-bit word: its lowest bit, and its largest code.
COMMAND_SHIFT, COMMAND_MAX = np.array([[48, 36, 24, 12, 0], [0xFFFF, 0xFFF, 0xFFF, 0xFFF, 0xFFF]], np.uint64)
FEEDBACK_SHIFT, FEEDBACK_MAX = np.array([[40, 28, 16, 56, 8, 0], [0xFFFF, 0xFFF, 0xFFF, 0xFF, 0xFF, 0xFF]], np.uint64)
COMMAND_WEIGHT, FEEDBACK_WEIGHT = np.uint64(1) << COMMAND_SHIFT, np.uint64(1) << FEEDBACK_SHIFT

# Seven bytes of FF and one more switch a motor on or off, zero it or (RobStride) renumber it, whatever the ranges: a
# command that saturates everywhere would be one of them. Keeping the velocity one code below full scale puts at most EF
# in byte 3, so that not even a prefix of FF x 6 can be produced.
VELOCITY_CODE_MAX = 0xFFE

# Added before truncation, so that what a code decodes to is encoded as that code again and not, by the rounding of the
# division, as the one below. The firmware's own float32 arithmetic is a thousand times coarser.
ROUNDING = 1e-6


class Ranges(NamedTuple):
    """Full scale of each quantity of each motor, arrays (n,): symmetric about 0, but kp and kd start at 0."""

    position: np.ndarray  # rad
    velocity: np.ndarray  # rad/s
    torque: np.ndarray  # N m
    kp: np.ndarray  # N m/rad
    kd: np.ndarray  # N m s/rad


class MitFeedback(NamedTuple):
    """One reply per row, arrays (m,): the motion, and the three bytes whose meaning is the vendor's (as floats)."""

    position: np.ndarray  # rad
    velocity: np.ndarray  # rad/s
    torque: np.ndarray  # N m
    byte0: np.ndarray
    byte6: np.ndarray
    byte7: np.ndarray


class MitCodec:
    """Packs and unpacks frames of n motors, of one bus or of several one after the other.

    Built once: scales, word positions and scratch arrays live here, so that a call is a handful of numpy operations on
    (quantity, motor) arrays. Not re-entrant.
    """

    def __init__(self, ranges: Ranges) -> None:
        position, velocity, torque, kp, kd = (np.asarray(r, float) for r in ranges)
        self.n = n = len(position)
        zero = np.zeros(n)
        self._low = np.array([-position, -velocity, zero, zero, -torque])
        self._high = np.array([position, velocity, kp, kd, torque])
        lsb = (self._high - self._low) / COMMAND_MAX[:, None]  # one code, in SI
        self._scale = 1.0 / lsb
        self._offset = ROUNDING - self._low * self._scale
        self._saturation = self._high.copy()
        self._saturation[1] = self._low[1] + VELOCITY_CODE_MAX * lsb[1]

        # Unpacking masks a quantity where it is in the word, and lets the scale undo the shift (a power of two: exact).
        self._command_mask = (COMMAND_MAX << COMMAND_SHIFT)[:, None]
        self._command_scale = np.array([lsb / 2.0 ** COMMAND_SHIFT[:, None], self._low])
        motion = [0, 1, 4]
        byte = np.ones((3, n))
        self._feedback_mask = (FEEDBACK_MAX << FEEDBACK_SHIFT)[:, None]
        self._feedback_scale = np.array(
            [np.vstack([lsb[motion], byte]) / 2.0 ** FEEDBACK_SHIFT[:, None], np.vstack([self._low[motion], 0 * byte])]
        )

        self._values = np.empty((5, n))
        self._finite = np.empty((5, n), bool)
        self._codes = np.empty((5, n), np.uint64)

    def pack_command(
        self,
        position: np.ndarray,
        velocity: np.ndarray,
        kp: np.ndarray,
        kd: np.ndarray,
        torque: np.ndarray,
    ) -> np.ndarray:
        """Payloads (n, 8) uint8 of arrays (n,) in SI units. Out-of-range values saturate; never a magic frame.

        Raises ValueError naming the first value that is not finite.
        """
        x = self._values
        x[0], x[1], x[2], x[3], x[4] = position, velocity, kp, kd, torque
        np.isfinite(x, out=self._finite)
        if np.count_nonzero(self._finite) < x.size:
            quantity, motor = np.argwhere(~self._finite)[0]
            raise ValueError(
                f"command of motor {motor} (counted from 0): got {QUANTITIES[quantity]} "
                f"{x[quantity, motor]}, expected a finite value; nothing was packed"
            )
        np.minimum(x, self._saturation, out=x)
        np.maximum(x, self._low, out=x)
        np.multiply(x, self._scale, out=x)
        np.add(x, self._offset, out=x)
        self._codes[...] = x  # truncates
        return _join(self._codes, COMMAND_WEIGHT)

    def unpack_command(self, data: np.ndarray, index: np.ndarray | None = None) -> MotorCommand:
        """What payloads (m, 8) uint8 ask for. ``index`` (m,): whose each one is; without it row i is motor i's."""
        return MotorCommand(*_split(data, self._command_mask, self._command_scale, index))

    def pack_feedback(
        self,
        position: np.ndarray,
        velocity: np.ndarray,
        torque: np.ndarray,
        byte0: np.ndarray,
        byte6: np.ndarray | int,
        byte7: np.ndarray | int,
        wrap: bool = False,
    ) -> np.ndarray:
        """Replies (n, 8) uint8 of finite arrays (n,) in SI units; ``byte0``, ``byte6``, ``byte7`` are cut to 8 bits.

        ``wrap``: a position out of range comes back in from the other end, as in the original firmware, which does not
        clamp; otherwise it saturates. Velocity and torque saturate.
        """
        x = self._values
        x[0], x[1], x[4] = position, velocity, torque
        x[2:4] = 0.0
        saturated = x[1:] if wrap else x
        np.minimum(saturated, self._high[-len(saturated) :], out=saturated)
        np.maximum(saturated, self._low[-len(saturated) :], out=saturated)
        np.multiply(x, self._scale, out=x)
        np.add(x, self._offset, out=x)
        codes = np.empty((6, self.n), np.int64)
        codes[0], codes[1], codes[2] = x[0], x[1], x[4]
        codes[3], codes[4], codes[5] = byte0, byte6, byte7
        return _join(codes.view(np.uint64) & FEEDBACK_MAX[:, None], FEEDBACK_WEIGHT)

    def unpack_feedback(self, data: np.ndarray, index: np.ndarray | None = None) -> MitFeedback:
        """What replies (m, 8) uint8 say. ``index`` (m,): whose each one is; without it row i is motor i's."""
        return MitFeedback(*_split(data, self._feedback_mask, self._feedback_scale, index))


def words_of(data: np.ndarray) -> np.ndarray:
    """Payloads (m, 8) uint8 as big-endian 64-bit numbers, (m,) uint64; rows may be strided, as in a FRAME array."""
    return data.view(">u8")[:, 0].astype(np.uint64)


def _join(codes: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Payloads (n, 8) uint8 of codes (quantity, n). They do not overlap, so that shift and "or" are one product."""
    return weight.dot(codes).astype(">u8").view(np.uint8).reshape(-1, 8)


def _split(data: np.ndarray, mask: np.ndarray, scale: np.ndarray, index: np.ndarray | None) -> np.ndarray:
    """Values (quantity, m) of payloads (m, 8). ``scale`` (2, quantity, n): factor and offset of each motor."""
    factor, low = scale if index is None else scale.take(index, axis=2)
    x = (words_of(data) & mask).astype(float)
    np.multiply(x, factor, out=x)
    return np.add(x, low, out=x)
