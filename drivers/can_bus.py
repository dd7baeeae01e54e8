"""MotorBus over a CAN wire. What the frames mean is the codec's; here are the connecting, the counting and the clock.

A protocol is added by one codec file with a class like CanCodec, and one line in ``drivers/open.py``.

When the transmit queue is full (ENOBUFS: nobody acknowledges, or the bus is overloaded) the rest of the tick is dropped,
never queued for later; after QUEUE_FULL_TIME of it every write raises BusError. What the kernel already holds cannot be
taken back: at most ``txqueuelen`` (default 10) frames go out when the bus comes back. They are commands, never an
"enable", and by then the watchdog programmed while connecting has disabled the motors, which ignore them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby
from typing import NamedTuple, NoReturn, Protocol

import numpy as np

from drivers.bus import BusCounters, BusError, BusSpec, Clock, MotorBus, MotorCommand, MotorSpec, MotorState
from drivers.wire import ERROR, FRAME, CanWire, WireError, WireFull

TRIES = 7  # of a request while connecting: a motor that loses every tenth frame still connects
ANSWER_TIME = 0.04  # s to wait for the answers to one try
POLL_PERIOD = 0.001  # s between two looks at the wire while waiting
QUEUE_FULL_TIME = 1.0  # s with no tick going out whole, then the bus is dead
REGISTER_TOLERANCE = 1e-4  # relative, of a float register
NOTHING = np.zeros(0, FRAME)


class RegisterCheck(NamedTuple):
    """A register that must hold ``expected`` (n,) on every motor before torque; ``write`` it first, then read it back."""

    register: str
    expected: np.ndarray
    consequence: str  # of another value, and what to do: ends the error message
    write: bool = False


class RegisterAnswer(NamedTuple):
    """What a motor says of one of its registers."""

    row: int  # which motor of the bus
    register: str
    value: float | int  # NaN: the motor has no such register
    written: bool  # the answer to a write, not to a read


class TickCodec(Protocol):
    """What a protocol whose tick is one frame to and one from each motor does for n motors, whatever buses they are on."""

    def __init__(self, motors: Sequence[MotorSpec]) -> None: ...

    def pack_command(self, command: MotorCommand) -> np.ndarray: ...

    def unpack_whole(self, frames: np.ndarray, state: MotorState, now: float) -> bool:
        """Put ``frames`` into ``state`` if they are an answer of every motor in turn, else leave it. Returns which."""
        ...


class CanCodec(Protocol):
    """One protocol on CAN, for the n motors of one bus. Pure: frames in and out, no wire, no clock.

    One whose tick is plain says in ``TICK`` which TickCodec it has for motors on several buses. One whose motors say
    themselves how far their position can be trusted has in ``HOME`` the register, and by its value what TURN is. ``NEWER``:
    of IDENTITY, those that older firmware does not answer.
    """

    TICK_BITS: tuple[float, float]  # bits of a motor's command and answer on the wire: typical, worst
    IDENTITY: tuple[str, ...]  # registers that tell a motor from any other, or at least from one of another make
    TURN: float  # rad by whose multiples a position may be off after power-on; 0: nobody knows where it starts
    checks: list[RegisterCheck]

    def pack_command(self, command: MotorCommand) -> np.ndarray: ...

    def pack_enable(self, state: MotorState) -> np.ndarray: ...

    def pack_disable(self) -> np.ndarray: ...

    def pack_poll(self, state: MotorState) -> np.ndarray: ...

    def pack_register(self, row: int, register: str, value: float | int | None = None) -> np.ndarray: ...

    def unpack_registers(self, frames: np.ndarray) -> list[RegisterAnswer]: ...

    def unpack(self, frames: np.ndarray, state: MotorState, now: float) -> int: ...

    def owners(self, frames: np.ndarray) -> np.ndarray: ...

    def error_name(self, code: int) -> str: ...


class CanBus:
    """The motors of one CAN bus (a ``drivers.bus.MotorBus``)."""

    def __init__(self, spec: BusSpec, codec: CanCodec, wire: CanWire) -> None:
        self.spec = spec
        self.counters = BusCounters(extra={"bus_errors": 0, "disable_failed": 0})
        self._codec = codec
        self._wire = wire
        self._clock: Clock | None = None
        self._state = MotorState.empty(len(spec.motors))
        self._strangers: set[int] = set()  # identifiers of frames from nobody on this bus, while connecting
        self._whole = 0.0  # s, when a tick last went out whole

    def connect(self, clock: Clock) -> None:
        """Disable every motor, compare its registers with the wiring, program the watchdog and hear its state.

        Takes up to TRIES * ANSWER_TIME for each register, all motors at once. Raises BusError naming every motor that
        does not answer, or that answers something else.
        """
        self._clock = clock
        self._whole = clock.now()
        self._strangers.clear()
        self._receive()  # what others left there
        self._transmit(self._codec.pack_disable(), required=True)
        for check in self._codec.checks:
            self._check(check, clock)
        self._hear_all(clock)

    def poll(self) -> None:
        self._refuse_unconnected()
        self._transmit(self._codec.pack_poll(self._state))

    def enable(self) -> None:
        """Raises BusError if not every frame went out: some motors may be enabled then, so disable."""
        self._refuse_unconnected()
        self._transmit(self._codec.pack_enable(self._state), required=True)

    def disable(self) -> None:
        try:
            self._wire.send(self._codec.pack_disable())
            self.counters.sent += len(self.spec.motors)
        except Exception:  # the stop path goes on: the other buses, and the motors' own watchdogs
            self.counters.extra["disable_failed"] += 1

    def write(self, command: MotorCommand) -> None:
        """Before ``connect`` only damping (kp 0) is sent: it is what is left to do for a process that has died."""
        self._refuse_torque(command)
        self._transmit(self._codec.pack_command(command))

    def read(self, now: float) -> MotorState:
        self._take(self._receive(), now)
        return self._state

    def error_name(self, code: int) -> str:
        return self._codec.error_name(code)

    def fingerprints(self) -> list[str]:
        if self._clock is None:
            raise BusError(f"bus {self.spec.name}: not connected; call connect(clock) first")
        told: dict[int, list[str]] = {row: [] for row in range(len(self.spec.motors))}
        newer = getattr(self._codec, "NEWER", ())
        for name in self._codec.IDENTITY:
            values = self._ask(RegisterCheck(name, self._unknown, ""), [], self._clock, required=name not in newer)
            for row, value in values.items():
                told[row].append(f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}")
            if len(values) < len(told):
                break  # what comes next is newer still
        return [", ".join(words) for words in told.values()]

    def turns(self) -> list[float]:
        if self._clock is None:
            raise BusError(f"bus {self.spec.name}: not connected; call connect(clock) first")
        if (home := getattr(self._codec, "HOME", None)) is None:
            return [self._codec.TURN for _ in self.spec.motors]
        register, turn = home
        told = self._ask(RegisterCheck(register, self._unknown, ""), [], self._clock)
        return [turn.get(told[row], np.nan) for row in range(len(self.spec.motors))]

    @property
    def _unknown(self) -> np.ndarray:
        return np.full(len(self.spec.motors), np.nan)

    def close(self) -> None:
        self._wire.close()

    def _refuse_unconnected(self) -> None:
        if self._clock is None:
            raise BusError(f"bus {self.spec.name}: not connected; call connect(clock) first")

    def _refuse_torque(self, command: MotorCommand) -> None:
        """Raise BusError before ``connect`` for a command that is more than damping."""
        if self._clock is None and np.any(command.kp):
            self._refuse_unconnected()

    def _transmit(self, frames: np.ndarray, required: bool = False) -> None:
        """Send one tick. ``required``: a full queue is an error at once, and not only after QUEUE_FULL_TIME."""
        try:
            self._wire.send(frames)
        except WireFull as error:
            self.counters.lost += 1
            if required or self._clock is None or self._clock.now() - self._whole >= QUEUE_FULL_TIME:
                raise BusError(
                    f"bus {self.spec.name} ({self._where()}): the transmit queue is full; got no acknowledgement, "
                    f"expected frames to leave within {0 if required else QUEUE_FULL_TIME:g} s.\n"
                    "  Check motor power, wiring, termination and bit rate (`ip -s link` shows bus-off), and that the "
                    f"queue holds a tick (`ip link set ... txqueuelen 100`); then connect again ({error})"
                ) from error
        except WireError as error:
            raise BusError(f"bus {self.spec.name} ({self._where()}): {error}") from error
        else:
            self.counters.sent += len(frames)
            if self._clock is not None:
                self._whole = self._clock.now()

    def _receive(self) -> np.ndarray:
        """What arrived, with what the controller says of itself (ERROR)."""
        try:
            return self._wire.recv()
        except WireError as error:
            raise BusError(f"bus {self.spec.name} ({self._where()}): {error}") from error

    def _heard(self, frames: np.ndarray) -> np.ndarray:
        """Those of ``frames`` that are a motor's; errors are counted."""
        error = frames["id"] & ERROR
        if errors := np.count_nonzero(error):
            self.counters.extra["bus_errors"] += int(errors)
            frames = frames[error == 0]
        self.counters.received += len(frames)
        return frames

    def _take(self, frames: np.ndarray, now: float) -> None:
        """Put what arrived into the state."""
        if len(frames := self._heard(frames)):
            self.counters.rejected += self._codec.unpack(frames, self._state, now)

    def _check(self, check: RegisterCheck, clock: Clock) -> None:
        """Write (if it is to be written) and read back one register of every motor, and compare."""
        expected = check.expected.tolist()
        got = self._ask(check, expected, clock)
        wrong = [
            f"bus {self.spec.name}, motor of {m.joint} (id {m.id:#x}, {m.model}): register {check.register} is "
            f"{got[row]:g}, expected {expected[row]:g}"
            for row, m in enumerate(self.spec.motors)
            if not _agree(got[row], expected[row])
        ]
        if wrong:
            raise BusError("\n".join(wrong) + f"\n  {check.consequence}")

    def _ask(
        self, check: RegisterCheck, expected: list[float], clock: Clock, required: bool = True
    ) -> dict[int, float | int]:
        """What every motor's register holds, {row: value}; not ``required``: only of those that say it. What is to be
        written goes ahead of each question, until it has arrived: not every protocol confirms a write, and any frame
        may get lost.
        """
        answers: dict[int, float | int] = {}
        motors = range(len(self.spec.motors))

        def settled(row: int) -> bool:
            return row in answers and (not check.write or _agree(answers[row], expected[row]))

        def request() -> np.ndarray:
            frames = []
            for row in motors:
                if not settled(row):
                    if check.write:
                        frames.append(self._codec.pack_register(row, check.register, expected[row]))
                    frames.append(self._codec.pack_register(row, check.register))
            return np.concatenate(frames)

        def take(frames: np.ndarray) -> bool:
            for answer in self._codec.unpack_registers(frames):
                if answer.register == check.register and not answer.written:
                    answers[answer.row] = answer.value
            return all(map(settled, motors))

        self._converse(request, take, clock)
        if required and (silent := [row for row in motors if row not in answers]):
            self._refuse_silence(silent, f"a request for register {check.register}")
        return answers

    def _hear_all(self, clock: Clock) -> None:
        """Take in a state of every motor from after it was disabled, and make sure that it is."""
        asked = clock.now()

        def take(frames: np.ndarray) -> bool:
            self.counters.rejected += self._codec.unpack(frames, self._state, clock.now())
            return bool((self._state.time >= asked).all())

        if not self._converse(lambda: self._codec.pack_poll(self._state), take, clock):
            self._refuse_silence(np.flatnonzero(self._state.time < asked).tolist(), "a request for its state")
        for row in np.flatnonzero(self._state.enabled):
            m = self.spec.motors[row]
            raise BusError(
                f"bus {self.spec.name}, motor of {m.joint} (id {m.id:#x}): enabled, expected disabled while connecting."
                "\n  Does another program command it? Stop that, and connect again"
            )

    def _converse(self, request: Callable[[], np.ndarray], take: Callable[[np.ndarray], bool], clock: Clock) -> bool:
        """Send what ``request`` makes and give ``take`` what arrives until it is content, up to TRIES times."""
        for _ in range(TRIES):
            self._transmit(request(), required=True)
            end = clock.now() + ANSWER_TIME
            while clock.now() < end:
                clock.sleep_until(clock.now() + POLL_PERIOD)
                frames = self._heard(self._receive())
                self._strangers.update(frames["id"][self._codec.owners(frames) < 0].tolist())
                if take(frames):
                    return True
        return False

    def _refuse_silence(self, rows: list[int], question: str) -> NoReturn:
        """Raise BusError for motors that did not answer."""
        heard = ", ".join(f"{i:#x}" for i in sorted(self._strangers)) or "none"
        lines = [
            f"bus {self.spec.name}, motor of {m.joint} (id {m.id:#x}): no answer"
            f"{f' on {m.feedback_id:#x}' if m.feedback_id else ''} to {question}, "
            f"tried {TRIES} times for {ANSWER_TIME * 1e3:g} ms"
            for m in (self.spec.motors[row] for row in rows)
        ]
        hint = f"Frames from other identifiers: {heard}. Check power, connector, id and feedback_id, and the bit rate"
        raise BusError("\n".join(lines) + f"\n  {self._where()}: {hint} ({self.spec.bitrate} bit/s)")

    def _where(self) -> str:
        return f"{self.spec.interface} {self.spec.channel}".strip()


def _agree(got: float, expected: float) -> bool:
    """NaN agrees with nothing."""
    return abs(got - expected) <= REGISTER_TOLERANCE * abs(expected)


class CanBuses:
    """Several buses as one to ``read`` and ``write``: a tick of all their motors is packed and unpacked in one call.

    Each bus stays what it is, with its own wire, counters and failures. What is not one answer of every motor in turn
    (something was lost, or an error frame came) is taken apart bus by bus.
    """

    def __init__(self, buses: Sequence[CanBus], codec: TickCodec) -> None:
        self._buses, self._codec = buses, codec
        ends = np.cumsum([len(bus.spec.motors) for bus in buses]).tolist()
        self._rows = [slice(end - len(bus.spec.motors), end) for bus, end in zip(buses, ends, strict=True)]
        self._state = MotorState.concatenate([bus._state for bus in buses])
        for bus, rows in zip(buses, self._rows, strict=True):
            bus._state = self._state.part(rows)

    def read(self, now: float) -> MotorState:
        """As of a MotorBus. A bus that fails keeps its state; the first failure is raised when all have been read."""
        arrived, failures = [], []
        for bus in self._buses:
            try:
                arrived.append(bus._receive())
            except BusError as error:
                failures.append(error)
                arrived.append(NOTHING)
        frames = np.frombuffer(
            b"".join([f.tobytes() for f in arrived]), FRAME
        )  # np.concatenate takes ten times as long
        whole = self._codec.unpack_whole(frames, self._state, now)
        for bus, frames in zip(self._buses, arrived, strict=True):
            if whole:
                bus.counters.received += len(frames)
            else:
                bus._take(frames, now)
        if failures:
            raise failures[0]
        return self._state

    def write(self, command: MotorCommand) -> None:
        """As of a MotorBus. A bus that fails is told when all have been written to."""
        frames, failures = self._codec.pack_command(command), []
        for bus, rows in zip(self._buses, self._rows, strict=True):
            try:
                bus._refuse_torque(command)
                bus._transmit(frames[rows])
            except BusError as error:
                failures.append(error)
        if failures:
            raise failures[0]


def joined(buses: Sequence[MotorBus]) -> list[tuple[MotorBus | CanBuses, int]]:
    """``buses`` in their order, neighbours of one protocol as CanBuses where it has a TickCodec; and how many motors each
    has."""

    def tick(bus: MotorBus) -> type[TickCodec] | None:
        return getattr(bus._codec, "TICK", None) if isinstance(bus, CanBus) else None

    parts: list[tuple[MotorBus | CanBuses, int]] = []
    for codec, group in groupby(buses, tick):
        some = list(group)
        motors = [m for bus in some for m in bus.spec.motors]
        if codec is None or len(some) == 1:
            parts += [(bus, len(bus.spec.motors)) for bus in some]
        else:
            parts.append((CanBuses([bus for bus in some if isinstance(bus, CanBus)], codec(motors)), len(motors)))
    return parts
