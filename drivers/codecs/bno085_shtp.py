"""BNO080, BNO085 and BNO086 in UART-SHTP mode (PS1 high, PS0 low; 3 Mbit/s): bytes to SI and back, and how they are set up.
The line and its packets are in shtp.py.

    cargo  = of channel 3: reports, one after the other: id | sequence number | status | delay | i16 ...

Three reports make a sample: acceleration (01, 2^-8 m/s^2), angular velocity (02, 2^-9 rad/s) and the orientation without
magnetometer (08, i, j, k, real, 2^-14). A sample is complete with its orientation, where both others came since the one before.

A sensor starts with everything off, so the host says which reports it wants, how often (``ask``), and again after every reset,
which the sensor tells. Before a frame it asks for room (control frame without content, answered by the number of bytes). Bytes
to the sensor must be 100 us apart: one goes out at each call, so that this takes about half a second at 500 calls a second.

**There is no checksum on this line.** A damaged length, channel or escape is found, a damaged value only where the quaternion's
length is no longer 1. Keep the line short.

Source: CEVA/Hillcrest, "BNO08X Data Sheet" (1000-3927), 1.3.3, 1.4 and 5.2 (its figures 1-26 to 1-35, 5-1 and 5-2 are what
the tests have).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from drivers.codecs.shtp import CONTROL, FRAME_MAX, ROOM, Channel, Framer, Packet, line, pack

SPACING = 100e-6  # s between two bytes to the sensor
PATIENCE = 0.05  # s for an answer, before a question is put again
SILENCE = 1.0  # s without a sample, after which the sensor is set up again


class Report(IntEnum):
    """First byte of a report."""

    ACCELERATION = 0x01
    ANGULAR_VELOCITY = 0x02
    ORIENTATION = 0x08  # "game rotation vector": without magnetometer
    PRODUCT_ANSWER = 0xF8
    PRODUCT_QUESTION = 0xF9
    REBASE = 0xFA
    TIME_BASE = 0xFB
    FEATURE_ANSWER = 0xFC
    SET_FEATURE = 0xFD


WANTED = {  # report: (numbers, of one bit in SI)
    Report.ACCELERATION: (3, 2.0**-8),
    Report.ANGULAR_VELOCITY: (3, 2.0**-9),
    Report.ORIENTATION: (4, 2.0**-14),
}
LENGTHS = {int(r): 4 + 2 * numbers for r, (numbers, _) in WANTED.items()}
LENGTHS |= {int(r): 5 for r in (Report.TIME_BASE, Report.REBASE)}
FEATURE = np.dtype(
    [("report", "u1"), ("feature", "u1"), ("flags", "u1"), ("sensitivity", "<u2"), ("interval", "<u4"), ("batch", "<u4"),
     ("specific", "<u4")]
)  # fmt: skip
RESET = b"\x01"  # to the executable, and from it: it is complete


class Sample(NamedTuple):
    """What three reports say, in the sensor's own frame."""

    acceleration: np.ndarray  # (3,) m/s^2, +g upwards at rest
    angular_velocity: np.ndarray  # (3,) rad/s
    orientation: np.ndarray  # (4,) w, x, y, z


def pack_feature(report: Report, interval: float, answer: bool = False) -> bytes:
    """The cargo that asks for a report every ``interval`` s (0: never); or the sensor's answer to it."""
    feature = np.zeros(1, FEATURE)
    feature["report"] = Report.FEATURE_ANSWER if answer else Report.SET_FEATURE
    feature["feature"], feature["interval"] = report, round(interval * 1e6)
    return feature.tobytes()


def pack_reports(sample: Sample, sequence: int) -> bytes:
    """The cargo of a sample: time base and three reports. Saturates."""
    w, x, y, z = sample.orientation
    values = {
        Report.ACCELERATION: sample.acceleration,
        Report.ANGULAR_VELOCITY: sample.angular_velocity,
        Report.ORIENTATION: np.array([x, y, z, w]),
    }
    out = bytes([Report.TIME_BASE]) + bytes(4)
    for report, (_, bit) in WANTED.items():
        numbers = np.clip(np.rint(np.asarray(values[report], float) / bit), -32768, 32767).astype("<i2")
        out += bytes([report, sequence & 0xFF, 3, 0]) + numbers.tobytes()  # status 3: accurate
    return out


class Parser:
    """The host's side: samples from a byte stream, and what to say to the sensor that it sends them."""

    def __init__(self) -> None:
        self._framer = Framer()
        self._heard: dict[int, np.ndarray] = {}
        self._missing = list(WANTED)  # reports that the sensor has not confirmed
        self._bytes = b""  # on their way to the sensor
        self._room = 0  # bytes that it said it has room for
        self._spoke = self._sampled = -np.inf  # s, when something was said, and when a sample came
        self._sequence = 0
        self._damaged = 0
        self._new = False

    @property
    def rejected(self) -> int:
        """Frames that were none, or held what is no report."""
        return self._framer.rejected + self._damaged

    def feed(self, data: bytes) -> list[Sample]:
        """Every sample completed by ``data``, oldest first."""
        samples = []
        for packet in self._framer.feed(data):
            if packet.channel == -1 and len(packet.cargo) == 2:
                self._room = int.from_bytes(packet.cargo, "little")
            elif packet.channel == Channel.EXECUTABLE and packet.cargo == RESET:
                self._missing = list(WANTED)
            elif packet.channel == Channel.CONTROL and packet.cargo[0] == Report.FEATURE_ANSWER:
                self._confirm(packet.cargo)
            elif packet.channel == Channel.REPORTS:
                samples += self._unpack(packet.cargo)
        self._new |= bool(samples)
        return samples

    def ask(self, now: float, rate: float) -> bytes:
        """What to write to the sensor now (at most one byte), for samples at ``rate`` Hz."""
        if self._new:
            self._sampled, self._new = now, False
        if self._bytes and now - self._spoke < SPACING:
            return b""
        if self._bytes:
            byte, self._bytes = self._bytes[:1], self._bytes[1:]
            self._spoke = now
            return byte
        if self._missing and now - self._spoke > PATIENCE or self._missing and self._room:
            frame = pack(Channel.CONTROL, self._sequence, pack_feature(self._missing[0], 1 / rate))
            if self._room >= len(frame):
                self._sequence += 1
                self._missing.append(self._missing.pop(0))  # until it is confirmed, after the others again
                self._bytes = frame
            else:
                self._bytes = ROOM
            self._room = 0
        elif not self._missing and now - max(self._sampled, self._spoke) > SILENCE:
            self._missing = list(WANTED)
        return b""

    def _confirm(self, cargo: bytes) -> None:
        if len(cargo) == FEATURE.itemsize:
            feature = np.frombuffer(cargo, FEATURE)[0]
            if feature["interval"] and feature["feature"] in self._missing:
                self._missing.remove(Report(int(feature["feature"])))

    def _unpack(self, cargo: bytes) -> Iterator[Sample]:
        at = 0
        while at < len(cargo):
            report = cargo[at]
            size = LENGTHS.get(report, 0)
            if not size or at + size > len(cargo):
                self._damaged += 1
                return
            if report in WANTED:
                numbers, bit = WANTED[Report(report)]
                self._heard[report] = np.frombuffer(cargo, "<i2", numbers, at + 4) * bit
            at += size
            if report == Report.ORIENTATION:
                heard, self._heard = self._heard, {}
                if len(heard) == len(WANTED):
                    x, y, z, w = heard[Report.ORIENTATION]
                    orientation = np.array([w, x, y, z])
                    yield Sample(heard[Report.ACCELERATION], heard[Report.ANGULAR_VELOCITY], orientation)


class Sensor:
    """The sensor's side (a ``drivers.sim.imu.Sensor``): silent until it was told which reports to send."""

    RATE_MAX = 400.0  # Hz, of the orientation

    def __init__(self) -> None:
        self._framer = Framer()
        self._intervals: dict[int, float] = {}  # s, by report
        self._due = 0.0
        self._sequences = [0] * len(Channel)
        self._greeting = True

    def pack(
        self, time: float, orientation: Sequence[float], spin: Sequence[float], acceleration: Sequence[float]
    ) -> bytes:
        if self._greeting:
            self._greeting = False
            return self._greet()
        if not all(self._intervals.get(report) for report in WANTED) or time + 1e-9 < self._due:
            return b""
        self._due = max(time, self._due + max(self._intervals.values()))
        sample = Sample(np.asarray(acceleration), np.asarray(spin), np.asarray(orientation))
        return self._say(Channel.REPORTS, pack_reports(sample, self._sequences[Channel.REPORTS]))

    def hear(self, data: bytes) -> bytes:
        """What the host writes; its answer."""
        return b"".join(self._answer(packet) for packet in self._framer.feed(data))

    def _answer(self, packet: Packet) -> bytes:
        channel, cargo = packet
        if channel == -1 and not cargo:
            return line(CONTROL, FRAME_MAX.to_bytes(2, "little"))
        if channel == Channel.EXECUTABLE and cargo == RESET:
            self._intervals.clear()
            return self._greet()
        if channel == Channel.CONTROL and cargo[0] == Report.PRODUCT_QUESTION:
            product = bytes([Report.PRODUCT_ANSWER, 1, 3, 2]) + (10003608).to_bytes(4, "little") + bytes(8)
            return self._say(Channel.CONTROL, product)
        if channel == Channel.CONTROL and cargo[0] == Report.SET_FEATURE and len(cargo) == FEATURE.itemsize:
            feature = np.frombuffer(cargo, FEATURE)[0]
            interval = max(float(feature["interval"]) * 1e-6, 1 / self.RATE_MAX) if feature["interval"] else 0.0
            self._intervals[int(feature["feature"])] = interval
            answer = (
                bytes([Report.FEATURE_ANSWER]) + cargo[1:5] + round(interval * 1e6).to_bytes(4, "little") + cargo[9:]
            )
            return self._say(Channel.CONTROL, answer)
        return b""

    def _greet(self) -> bytes:
        """What a sensor says when it has started."""
        self._sequences = [0] * len(Channel)
        return self._say(Channel.COMMAND, bytes([0])) + self._say(Channel.EXECUTABLE, RESET)

    def _say(self, channel: Channel, cargo: bytes) -> bytes:
        self._sequences[channel] += 1
        return pack(channel, self._sequences[channel], cargo)

    def retell(self, packet: bytes, change: Callable[[bytearray], None]) -> bytes:
        """Only what it says of motion."""
        told = list(Framer().feed(packet))
        if len(told) != 1 or told[0].channel != Channel.REPORTS:
            return packet
        payload, at = bytearray(), 5
        for report, (numbers, _) in WANTED.items():
            payload += told[0].cargo[at + 4 : at + LENGTHS[report]]
            at += 4 + 2 * numbers
        change(payload)
        values = np.frombuffer(bytes(payload), "<i2").astype(float)
        x, y, z, w = values[6:] * WANTED[Report.ORIENTATION][1]
        sample = Sample(values[:3] * 2.0**-8, values[3:6] * 2.0**-9, np.array([w, x, y, z]))
        return self._say(Channel.REPORTS, pack_reports(sample, self._sequences[Channel.REPORTS]))
