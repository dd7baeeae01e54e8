"""Looking at servos that nobody has connected to: their registers where they are, for the indirect ones hold nothing yet."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drivers.bus import MotorState
from drivers.codecs.dynamixel import REGISTERS, TRIPPED, WATCHDOG_TRIPPED, DynamixelCodec
from drivers.codecs.dynamixel_packet import Instruction, pack_sync_read


class Look(NamedTuple):
    """Bytes of the control table from ``address`` on, as they are without any indirect register."""

    address: int
    fields: np.dtype  # some of them


def _look(*names: str) -> Look:
    """Of these registers, in the order of their addresses, and of all that lies between."""
    first, last = REGISTERS[names[0]], REGISTERS[names[-1]]
    kinds = {1: "u1", 2: "<i2", 4: "<i4"}
    fields = np.dtype(
        {
            "names": [name.lower() for name in names],
            "formats": [kinds[REGISTERS[name].size] for name in names],
            "offsets": [REGISTERS[name].address - first.address for name in names],
            "itemsize": last.address + last.size - first.address,
        }
    )
    return Look(first.address, fields)


# What is asked for in turn.
LOOKS = (
    _look("PRESENT_CURRENT", "PRESENT_VELOCITY", "PRESENT_POSITION", "PRESENT_TEMPERATURE"),
    _look("TORQUE_ENABLE", "HARDWARE_ERROR", "BUS_WATCHDOG"),
)


class DynamixelLook(DynamixelCodec):
    """The codec of somebody who only reads."""

    def pack_looks(self) -> list[bytes]:
        """Questions that, in turn, ask every servo for its state, whether or not it is connected; nothing is written."""
        return [pack_sync_read(self.ids.tobytes(), look.address, look.fields.itemsize) for look in LOOKS]

    def unpack_look(self, data: bytes, state: MotorState, now: float) -> int:
        """Put what answers to ``pack_looks`` say into ``state``. Returns how many were damaged, of nobody here, or of nothing
        asked."""
        motion, health = (look.fields for look in LOOKS)
        strangers, bad = 0, self._parser.rejected
        for p in self._parser.feed(data):
            row, told = int(self._row_of[p.id]), p.parameters[1:]
            if p.instruction != Instruction.STATUS:
                continue  # an adapter's echo of what was sent
            if row >= 0 and len(told) == motion.itemsize:
                item = np.frombuffer(told, motion)[0]
                raw = np.array([item["present_position"], item["present_velocity"], item["present_current"]], float)
                readings = (raw - self._zeros[:, row]) * self._units[:, row]
                state.position[row], state.velocity[row], state.torque[row] = readings
                state.temperature[row], state.time[row] = item["present_temperature"], now
            elif row >= 0 and len(told) == health.itemsize:
                item = np.frombuffer(told, health)[0]
                tripped = item["bus_watchdog"] == WATCHDOG_TRIPPED
                state.error[row] = item["hardware_error"] + TRIPPED * tripped
                state.enabled[row] = item["torque_enable"] == 1 and not tripped
            else:
                strangers += 1
        return strangers + self._parser.rejected - bad
