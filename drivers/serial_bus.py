"""MotorBus over a half-duplex serial wire (RS-485, TTL). What the bytes mean is the codec's; here are the connecting, the
turn-taking, the counting and the clock.

A tick is one write: the goals of all servos, and behind them a request for the state of all. Nobody waits for the answers:
``read`` takes in what arrived since, and a servo that said nothing keeps its old state, whose age tells.

**Turns.** Host and servos share the line, so that nothing must be sent while servos answer. A tick that comes while
answers are still due is dropped and counted (``lost``, ``line_busy``): never queued for later. Answers are due until the
last one came, or their time on the wire and REPLY_MARGIN have passed, so that a lost one costs less than that. Servos
that stayed silent are asked last the next time, the first of them after all others: it may be what these waited for.
The stop path does not take turns: ``disable`` sends at once, and every ``poll`` sends it again while a servo says that
its torque is on.

Where the codec knows a read that all servos answer in one packet, and all do so while connecting, it is used until
FAST_FAILURES of them in a row came back incomplete (drivers/codecs/dynamixel.py, "fast sync read").

**What a watchdog of such a servo does** is not damping: a Dynamixel stops where it is and holds, with the gains it has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, NoReturn, Protocol

import numpy as np

from drivers.bus import BusCounters, BusError, BusSpec, Clock, MotorCommand, MotorState
from drivers.wire import SerialWire, WireError, WireFull

BITS_PER_BYTE = 10  # start, 8 data, stop
REPLY_MARGIN = 0.0015  # s that answers may come late: 1 ms of a USB adapter's polling, and the servos' own gaps
FAST_FAILURES = 10
TRIES = 7  # of a request while connecting: a servo that loses every tenth packet still connects
ANSWER_TIME = 0.04  # s to wait for the answers to one try
POLL_PERIOD = 0.001  # s between two looks at the wire while waiting
REBOOT_TIME = 0.6  # s that a servo takes to come back
QUEUE_FULL_TIME = 1.0  # s with no tick going out whole, then the bus is dead


class RegisterCheck(NamedTuple):
    """A register that must be in ``low`` to ``high`` (one value, or one for each servo) on every servo before torque;
    ``write``: put ``low`` there first."""

    register: str
    low: int | Sequence[int]
    high: int | Sequence[int]
    consequence: str  # of another value, or what to do: ends the error message
    write: bool = False


class SerialCodec(Protocol):
    """One protocol on a serial line, for the n servos of one bus. Pure: bytes in and out, no wire, no clock."""

    TICK_BITS: tuple[float, float]  # bits of a servo's command and answer on the wire: typical, worst
    TICK_OVERHEAD_BITS: float  # bits of the packets around all of them
    IDENTITY: tuple[str, ...]  # registers that tell a servo from another; few do
    TURN: float  # rad by whose multiples a position may be off after power-on
    ERROR_REGISTER: str  # what a reboot clears; "": nothing does
    HAS_FAST_READ: bool
    checks: list[RegisterCheck]
    rejected: int

    def pack_wake(self) -> bytes: ...

    def pack_command(self, command: MotorCommand) -> bytes: ...

    def pack_request(self, rows: np.ndarray, fast: bool = False) -> bytes: ...

    def reply_size(self, n: int, fast: bool = False) -> int: ...

    def pack_enable(self, state: MotorState) -> bytes: ...

    def pack_disable(self) -> bytes: ...

    def pack_recover(self, state: MotorState) -> bytes: ...

    def pack_reboot(self, row: int) -> bytes: ...

    def pack_read(self, register: str, rows: np.ndarray) -> bytes: ...

    def pack_write(self, register: str, values: Sequence[int], rows: np.ndarray | None = None) -> bytes: ...

    def unpack(self, data: bytes, state: MotorState, now: float) -> int: ...

    def unpack_register(self, register: str, data: bytes) -> list[tuple[int, int]]: ...

    def finish(self, state: MotorState, now: float) -> int: ...

    def configure(self, values: dict[str, list[int]]) -> None: ...

    def error_name(self, code: int) -> str: ...


class SerialBus:
    """The servos of one serial bus (a ``drivers.bus.MotorBus``)."""

    def __init__(self, spec: BusSpec, codec: SerialCodec, wire: SerialWire) -> None:
        self.spec = spec
        self.counters = BusCounters(extra={"line_busy": 0, "disable_failed": 0, "fast_fallbacks": 0})
        self._codec = codec
        self._wire = wire
        self._clock: Clock | None = None
        self._state = MotorState.empty(len(spec.motors))
        self._byte = BITS_PER_BYTE / spec.bitrate
        self._everyone = np.arange(len(spec.motors))
        self._order = self._everyone  # of the next request
        self._asked = -np.inf  # s, when the last request was sent
        self._due = -np.inf  # s, when its answers are over at the latest
        self._heard = -np.inf  # s, when bytes last came
        self._open = False  # a request whose outcome is not settled
        self._answers = 0  # to it
        self._fast = False
        self._fast_failures = 0
        self._off = False  # switched off by ``disable``
        self._whole = 0.0  # s, when a tick last went out whole

    # -- connecting --------------------------------------------------------------------------------------------------

    def connect(self, clock: Clock) -> None:
        """Switch torque off, reboot servos with an error, compare every register that matters with the wiring, program
        the watchdog and hear every servo's state.

        Takes up to TRIES * ANSWER_TIME for each register, all servos at once, and REBOOT_TIME if one is rebooted. Raises
        BusError naming every servo that does not answer, or that answers something else.
        """
        self._clock = clock
        self._whole = clock.now()
        self._fast, self._open, self._due, self._order = False, False, -np.inf, self._everyone
        self._receive()  # what others left there
        self._codec.finish(self._state, clock.now())
        self._transmit(self._codec.pack_wake(), required=True)
        self._reboot(clock)
        values = {check.register: self._check(check, clock) for check in self._codec.checks}
        self._codec.configure(values)
        self._off = True
        if self._codec.HAS_FAST_READ:
            self._fast = self._hear_all(clock, fast=True, tries=2)
        if not self._fast and not self._hear_all(clock, fast=False, tries=TRIES):
            silent = np.flatnonzero(self._state.time <= self._asked)
            self._refuse_silence(silent.tolist(), "a request for its state")

    def _reboot(self, clock: Clock) -> None:
        """Reboot servos that report an error; what then still does is refused."""
        register = self._codec.ERROR_REGISTER
        if not register:
            return
        for attempt in range(2):
            errors = self._ask(register, clock)
            if not any(errors):
                return
            if attempt == 0:
                for row in np.flatnonzero(errors).tolist():
                    self._transmit(self._codec.pack_reboot(row), required=True)
                clock.sleep_until(clock.now() + REBOOT_TIME)
        lines = [
            f"bus {self.spec.name}, motor of {m.joint} (id {m.id}, {m.model}): {self._codec.error_name(error)}, also after "
            "a reboot, expected no error"
            for m, error in zip(self.spec.motors, errors, strict=True)
            if error
        ]
        raise BusError("\n".join(lines) + "\n  Check supply, load and temperature, then connect again")

    def _check(self, check: RegisterCheck, clock: Clock) -> list[int]:
        """Write (if it is to be written) and read back one register of every servo, and compare."""
        low, high = (
            list(v) if isinstance(v, Sequence) else [v] * len(self.spec.motors) for v in (check.low, check.high)
        )
        got: list[int] = []
        for _ in range(TRIES if check.write else 1):
            if check.write:
                self._transmit(self._codec.pack_write(check.register, low), required=True)
            got = self._ask(check.register, clock)
            if all(a <= g <= b for a, g, b in zip(low, got, high, strict=True)):
                return got
        wrong = [
            f"bus {self.spec.name}, motor of {m.joint} (id {m.id}, {m.model}): register {check.register} is {g}, expected "
            f"{a if a == b else f'{a} to {b}'}"
            for m, a, g, b in zip(self.spec.motors, low, got, high, strict=True)
            if not a <= g <= b
        ]
        raise BusError("\n".join(wrong) + f"\n  {check.consequence}")

    def _ask(self, register: str, clock: Clock) -> list[int]:
        """A register of every servo."""
        answers: dict[int, int] = {}

        def request() -> bytes:
            missing = [row for row in range(len(self.spec.motors)) if row not in answers]
            return self._codec.pack_read(register, np.array(missing))

        def take(data: bytes) -> bool:
            answers.update(self._codec.unpack_register(register, data))
            return len(answers) == len(self.spec.motors)

        if not self._converse(request, take, clock):
            missing = [row for row in range(len(self.spec.motors)) if row not in answers]
            self._refuse_silence(missing, f"a request for register {register}")
        return [answers[row] for row in range(len(self.spec.motors))]

    def _hear_all(self, clock: Clock, fast: bool, tries: int) -> bool:
        """Whether every servo told its state. ``fast``: all in one packet."""
        self._asked = clock.now()

        def take(data: bytes) -> bool:
            self._codec.unpack(data, self._state, clock.now())
            return bool((self._state.time > self._asked).all())

        return self._converse(lambda: self._codec.pack_request(self._everyone, fast), take, clock, tries)

    def _converse(
        self, request: Callable[[], bytes], take: Callable[[bytes], bool], clock: Clock, tries: int = TRIES
    ) -> bool:
        """Send what ``request`` makes and give ``take`` what arrives until it is content, up to ``tries`` times."""
        for attempt in range(tries):
            self._transmit(request(), required=True)
            end = clock.now() + ANSWER_TIME
            while clock.now() < end:
                clock.sleep_until(clock.now() + POLL_PERIOD)
                if take(self._receive()):
                    if attempt:  # late answers to the tries before must not pass for answers to the next question
                        clock.sleep_until(clock.now() + ANSWER_TIME)
                        self._receive()
                        self._codec.finish(self._state, clock.now())
                    return True
            self._codec.finish(self._state, clock.now())
        return False

    def _refuse_silence(self, rows: list[int], question: str) -> NoReturn:
        lines = [
            f"bus {self.spec.name}, motor of {m.joint} (id {m.id}): no answer to {question}, tried {TRIES} times for "
            f"{ANSWER_TIME * 1e3:g} ms"
            for m in (self.spec.motors[row] for row in rows)
        ]
        hint = "Check power, connector and id, that no other has the same id, and the bit rate"
        raise BusError("\n".join(lines) + f"\n  {self._where()}: {hint} ({self.spec.bitrate} bit/s)")

    # -- running -----------------------------------------------------------------------------------------------------

    def poll(self) -> None:
        if not self._my_turn():
            return
        off = self._codec.pack_disable() if self._off and self._state.enabled.any() else b""
        self._exchange(off + self._codec.pack_recover(self._state))

    def enable(self) -> None:
        """A line that is busy drops it: call it every tick until every servo says that it is enabled. Raises BusError if
        it did not go out whole: some servos may be enabled then, so disable."""
        self._off = False
        if self._my_turn():
            self._transmit(self._codec.pack_enable(self._state), required=True)

    def disable(self) -> None:
        self._off = True
        try:
            self._wire.write(self._codec.pack_disable())
            self.counters.sent += len(self.spec.motors)
        except Exception:  # the stop path goes on: the other buses, and the servos' own watchdogs
            self.counters.extra["disable_failed"] += 1

    def write(self, command: MotorCommand) -> None:
        goals = self._codec.pack_command(command)
        if self._my_turn():
            self._exchange(goals)

    def read(self, now: float) -> MotorState:
        data = self._receive()
        if data:
            self._heard = now
            answers = self._codec.unpack(data, self._state, now)
            self._answers += answers
            self.counters.received += answers
            self.counters.rejected = self._codec.rejected
            n = len(self.spec.motors)  # all heard: the line is the host's again
            if self._open and self._answers >= n and np.count_nonzero(self._state.time > self._asked) == n:
                self._open, self._order, self._fast_failures = False, self._everyone, 0
        return self._state

    def error_name(self, code: int) -> str:
        return self._codec.error_name(code)

    def fingerprints(self) -> list[str]:
        if self._clock is None:
            raise BusError(f"bus {self.spec.name}: not connected; call connect(clock) first")
        told = {name: self._ask(name, self._clock) for name in self._codec.IDENTITY}
        return [
            ", ".join(f"{name} {values[row]}" for name, values in told.items()) for row in range(len(self.spec.motors))
        ]

    def turns(self) -> list[float]:
        return [self._codec.TURN] * len(self.spec.motors)

    def close(self) -> None:
        self._wire.close()

    @property
    def waiting(self) -> float:
        """s for which answers to the last request may still come; 0: it is the host's turn."""
        if not self._open:
            return 0.0
        assert self._clock is not None
        return max(0.0, self._due - self._clock.now())

    # -- turns -------------------------------------------------------------------------------------------------------

    def _my_turn(self) -> bool:
        """Whether the line is the host's: the answers to the last request came (``read``), or their time is over."""
        if self._clock is None:
            raise BusError(f"bus {self.spec.name}: not connected; call connect(clock) first")
        if not self._open:
            return True
        if self.waiting > 0.0:
            self.counters.lost += 1
            self.counters.extra["line_busy"] += 1
            return False
        self._open = False
        self.counters.received += self._codec.finish(self._state, self._heard)
        self.counters.rejected = self._codec.rejected
        answered = self._state.time > self._asked
        silent = self._order[~answered[self._order]]
        # The first silent one may be the reason why those behind it are.
        self._order = np.concatenate([self._order[answered[self._order]], silent[1:], silent[:1]])
        if self._fast:
            self._fast_failures += 1
            if self._fast_failures >= FAST_FAILURES:
                self._fast = False
                self.counters.extra["fast_fallbacks"] += 1
        return True

    def _exchange(self, data: bytes) -> None:
        """Send ``data`` and a request for everybody's state behind it."""
        data += self._codec.pack_request(self._order, self._fast)
        self._transmit(data)
        assert self._clock is not None
        size = len(data) + self._codec.reply_size(len(self._order), self._fast)
        self._asked = self._clock.now()
        self._due = self._asked + size * self._byte + REPLY_MARGIN
        self._open = True
        self._answers = 0

    def _transmit(self, data: bytes, required: bool = False) -> None:
        """Send one tick. ``required``: a full queue is an error at once, and not only after QUEUE_FULL_TIME."""
        assert self._clock is not None
        try:
            self._wire.write(data)
        except WireFull as error:
            self.counters.lost += 1
            if required or self._clock.now() - self._whole >= QUEUE_FULL_TIME:
                raise BusError(
                    f"bus {self.spec.name} ({self._where()}): the port takes nothing, expected bytes to leave within "
                    f"{0 if required else QUEUE_FULL_TIME:g} s.\n  Check the adapter, then connect again ({error})"
                ) from error
        except WireError as error:
            raise BusError(f"bus {self.spec.name} ({self._where()}): {error}") from error
        else:
            self.counters.sent += len(self.spec.motors)
            self._whole = self._clock.now()

    def _receive(self) -> bytes:
        try:
            return self._wire.read()
        except WireError as error:
            raise BusError(f"bus {self.spec.name} ({self._where()}): {error}") from error

    def _where(self) -> str:
        return f"{self.spec.interface} {self.spec.channel}".strip()
