"""Serial wire (UART, USB serial, RS-485) over pyserial, which opens and sets the port; bytes go straight to the kernel."""

from __future__ import annotations

import os
import select

from drivers.wire import WireError, WireFull, WireGone

READ_SIZE = 65536  # bytes: more than any tick brings


class PySerialWire:
    """A serial port, 8N1, opened exclusively."""

    def __init__(self, device: str, baud: int) -> None:
        """Raises WireError if the port is absent, busy or not ours to open."""
        import serial

        self._where = f"serial {device} at {baud} baud"
        errors = (serial.SerialException, OSError)  # the former is an OSError in pyserial 3, by name elsewhere
        try:
            self._port = serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)  # non-blocking
            self._file = self._port.fileno()
        except (*errors, ValueError) as error:
            raise WireError(
                f"{self._where}: {error}\n  Is it plugged in, free, and is this user in the group that owns it (dialout)?"
            ) from None
        try:
            self._port.set_low_latency_mode(True)  # FTDI: 1 ms instead of 16 between two deliveries
        except (*errors, ValueError, AttributeError):
            pass  # not an adapter with such a timer

    def write(self, data: bytes) -> None:
        try:
            sent = os.write(self._file, data)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            raise WireGone(f"{self._where}: writing: {error}; unplugged?") from None
        if sent < len(data):
            raise WireFull(f"{self._where}: sent {sent} of {len(data)} bytes; the rest was dropped")

    def read(self) -> bytes:
        try:
            data = os.read(self._file, READ_SIZE)
            gone = (
                not data and select.select([self._file], [], [], 0)[0] and not (data := os.read(self._file, READ_SIZE))
            )
        except BlockingIOError:
            return b""
        except OSError as error:
            raise WireGone(f"{self._where}: reading: {error}; unplugged?") from None
        if gone:  # it has something to say, and that is nothing
            raise WireGone(f"{self._where}: reading: end of file; unplugged?")
        return data

    def fileno(self) -> int:
        return self._file

    def close(self) -> None:
        self._port.close()
        self._file = -1  # another file may get its number
