"""MotorBus over a DDS wire: the factory G1, whose motors are reached through its own computer.

Every write is one LowCmd with all motors in it, every read takes in the LowStates that arrived. Connecting refuses, by
name, what others found out on their robots: a robot of another variant, its own controllers still in charge, a second
program that commands it.

Not verified on a robot, for nobody has published it: what a G1's motors do when LowCmd stops. It has no watchdog that
could be programmed and read back, so nothing here promises that it damps; ``drivers.dds_wire`` says what follows from
that. This driver was only ever run against its simulated twin and over DDS loopback.
"""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np

from drivers.bus import BusCounters, BusError, BusSpec, Clock, MotorCommand, MotorState
from drivers.codecs import unitree_api as api
from drivers.codecs.unitree_hg import COMMAND_TOPIC, STATE_TOPIC, VARIANTS, UnitreeHgCodec, read_state
from drivers.wire import DdsWire, WireError

STATE_TIME = 3.0  # s to hear a first LowState: finding each other takes DDS about one
POLL_PERIOD = 0.002  # s between two looks at the wire while waiting
ANSWER_TIME = 1.0  # s to wait for a service's answer to one try
TRIES = 3  # of a request
RELEASES = 5  # how often the robot's controllers are asked to let go
RELEASE_TIME = 1.0  # s that they have for it each time
SETTLE_TIME = 0.02  # s until a command shows in what the robot says
DISABLE_TIME = 0.5  # s for every motor to say that it is disabled


class DdsBus:
    """The motors of a G1 (a ``drivers.bus.MotorBus``)."""

    def __init__(self, spec: BusSpec, codec: UnitreeHgCodec, wire: DdsWire) -> None:
        self.spec = spec
        self.counters = BusCounters(extra={"disable_failed": 0})
        self._codec = codec
        self._wire = wire
        self._clock: Clock | None = None
        self._state = MotorState.empty(len(spec.motors))
        self._mode_machine: int | None = None  # of the robot, once it fits
        self._heard: int | None = None  # the mode_machine of the last LowState, whether it fits or not
        self._tick = -1

    def connect(self, clock: Clock) -> None:
        """Hear the robot, compare its variant with the wiring, have its own controllers let go, and make sure that
        nobody else commands it. Takes up to about ten seconds. Raises BusError."""
        self._clock = clock
        self._read_wire()  # what is left there from before
        self._heard, self._mode_machine = None, None
        if not self._wait(clock, STATE_TIME, lambda: self._heard is not None):
            raise BusError(
                f"{self._name()}: no LowState on {STATE_TOPIC} within {STATE_TIME:g} s ({self.counters.rejected} samples "
                "rejected)\n  Is the robot on, its cable in, the channel its network interface and this computer's "
                "address 192.168.123.x? (`sim2real doctor` looks)"
            )
        self._fit()
        MotionSwitcher(self._wire, clock, self._name()).release()
        if others := self._wire.writers(COMMAND_TOPIC):
            raise BusError(
                f"{self._name()}: got {others} other publisher{'s' * (others > 1)} on {COMMAND_TOPIC}, expected none: "
                "their commands would alternate with ours\n  Stop that program, on this computer or on the robot's"
            )
        self._transmit(self._codec.pack_disable(self._known()))
        clock.sleep_until(clock.now() + SETTLE_TIME)
        self.read(clock.now())  # what was said before that arrived
        if not self._wait(clock, DISABLE_TIME, lambda: not self._state.enabled.any()):
            on = [m.joint for m, enabled in zip(self.spec.motors, self._state.enabled, strict=True) if enabled]
            raise BusError(f"{self._name()}: {', '.join(on)} enabled, expected disabled while connecting")

    def poll(self) -> None:
        """Nothing to ask: the robot publishes by itself."""

    def enable(self) -> None:
        """Every motor in mode 1 with all gains zero: it obeys, and makes no torque yet."""
        self._transmit(self._codec.pack_enable(self._known()))

    def disable(self) -> None:
        try:
            self._transmit(self._codec.pack_disable(self._known()))
        except Exception:  # noqa: BLE001 - the stop path goes on
            self.counters.extra["disable_failed"] += 1

    def write(self, command: MotorCommand) -> None:
        """Before ``connect`` only damping (kp 0) is sent: it is what is left to do for a process that has died."""
        if self._clock is None and np.any(command.kp):
            raise BusError(f"{self._name()}: not connected; call connect(clock) first")
        self._transmit(self._codec.pack_command(command, self._known()))

    def read(self, now: float) -> MotorState:
        """A LowState that is damaged, repeated, not finite, or of another variant is rejected; ages tell."""
        for payload in self._read_wire():
            self.counters.received += 1
            sample = read_state(payload)
            if sample is None or int(sample["tick"][0]) == self._tick:
                self.counters.rejected += 1
                continue
            self._tick, self._heard = int(sample["tick"][0]), int(sample["mode_machine"][0])
            if self._mode_machine not in (None, self._heard) or not self._codec.unpack(sample, self._state, now):
                self.counters.rejected += 1
        return self._state

    def error_name(self, code: int) -> str:
        return self._codec.error_name(code)

    def fingerprints(self) -> list[str]:
        """Nothing: LowState tells the robot's variant, and no serial number."""
        return [""] * len(self.spec.motors)

    def turns(self) -> list[float]:
        """The robot itself sees to it."""
        return [0.0] * len(self.spec.motors)

    @property
    def variant(self) -> int | None:
        """The robot's mode_machine, once it was heard."""
        return self._heard

    def close(self) -> None:
        self._wire.close()

    def _known(self) -> int:
        """The robot's mode_machine, which every LowCmd must echo. Raises BusError until a fitting robot was heard."""
        if self._mode_machine is None:
            self.read(-np.inf)  # of no use as a state: nobody knows when it came
            self._fit()
        assert self._mode_machine is not None
        return self._mode_machine

    def _fit(self) -> None:
        """Take over the robot's variant. Raises BusError naming every motor that is not what the wiring says."""
        if self._heard is None:
            raise BusError(f"{self._name()}: not a LowState heard yet; call connect(clock) first")
        if misfits := self._codec.misfits(self._heard):
            fitting = [v for v in VARIANTS if not self._codec.misfits(v)]
            table = "".join(f"\n    {v:3} {variant.description}" for v, variant in VARIANTS.items())
            listed = "".join(f"\n  {misfit}" for misfit in misfits)
            raise BusError(
                f"{self._name()}: got a robot with mode_machine {self._heard}, expected {' or '.join(map(str, fitting))}"
                f"{listed}\n  Limits and gains differ between variants: use a robot YAML for this one. Known variants:{table}"
            )
        self._mode_machine = self._heard

    def _wait(self, clock: Clock, time: float, content: Callable[[], bool]) -> bool:
        """Read until ``content``, at most ``time`` s. Returns whether it was."""
        end = clock.now() + time
        while clock.now() < end:
            clock.sleep_until(clock.now() + POLL_PERIOD)
            before = self._tick
            self.read(clock.now())
            if self._tick != before and content():
                return True
        return False

    def _transmit(self, payload: bytes) -> None:
        try:
            self._wire.write(COMMAND_TOPIC, payload)
        except WireError as error:
            raise BusError(f"{self._name()}: {error}") from error
        self.counters.sent += 1

    def _read_wire(self) -> list[bytes]:
        try:
            return self._wire.read(STATE_TOPIC)
        except WireError as error:
            raise BusError(f"{self._name()}: {error}") from error

    def _name(self) -> str:
        return f"bus {self.spec.name} ({self.spec.interface} {self.spec.channel})".replace(" )", ")")


class StateStream:
    """The IMU's end of a DDS wire (a drivers.wire.SerialWire): LowState payloads, one behind the other."""

    def __init__(self, wire: DdsWire) -> None:
        self._wire = wire

    def write(self, data: bytes) -> None:
        raise WireError("imu: got something to write, expected nothing: a LowState is only read")

    def read(self) -> bytes:
        return b"".join(self._wire.read(STATE_TOPIC))

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self._wire.close()


class MotionSwitcher:
    """The service through which the robot's own controllers take and give up its motors."""

    def __init__(self, wire: DdsWire, clock: Clock, where: str) -> None:
        self._wire, self._clock, self._where = wire, clock, where

    def release(self) -> None:
        """Have whatever controller is in charge let go; afterwards only a restart of the robot brings it back.

        Raises BusError if one survives RELEASES requests, or if the service does not say: then nobody knows who else
        commands the motors.
        """
        for _ in range(RELEASES):
            if not (mode := self.mode()):
                return
            self._call(api.RELEASE_MODE)
            end = self._clock.now() + RELEASE_TIME
            while mode and self._clock.now() < end:
                self._clock.sleep_until(self._clock.now() + RELEASE_TIME / 10)
                mode = self.mode()
        if mode := self.mode():
            raise BusError(
                f"{self._where}: the robot's controller '{mode}' is still in charge after {RELEASES} requests to release "
                "it, expected none\n  Hang the robot up and press L2+R2 on its remote (debug mode), then connect again"
            )

    def mode(self) -> str:
        """The controller in charge; "": none. Raises BusError."""
        data = self._call(api.CHECK_MODE)
        try:
            return str(json.loads(data)["name"])
        except (ValueError, KeyError, TypeError):
            raise BusError(f'{self._where}: motion_switcher answered {data!r}, expected {{"name": ...}}') from None

    def _call(self, number: int) -> str:
        """The data of the answer. Raises BusError if there is none, or it is a refusal."""
        try:
            for _ in range(TRIES):
                request = api.Request(int(self._clock.now() * 1e9), number)
                self._wire.write(api.MOTION_REQUEST, api.pack_request(request))
                end = self._clock.now() + ANSWER_TIME
                while self._clock.now() < end:
                    self._clock.sleep_until(self._clock.now() + POLL_PERIOD)
                    for payload in self._wire.read(api.MOTION_RESPONSE):
                        answer = api.unpack_response(payload)
                        if answer is None or answer.id != request.id:
                            continue
                        if answer.code:
                            raise BusError(
                                f"{self._where}: motion_switcher refuses request {number}: got code {answer.code}, "
                                "expected 0\n  Restart the robot, and connect again"
                            )
                        return answer.data
        except WireError as error:
            raise BusError(f"{self._where}: {error}") from error
        raise BusError(
            f"{self._where}: no answer from the robot's motion_switcher to request {number}, tried {TRIES} times for "
            f"{ANSWER_TIME:g} s; expected to hear which controller is in charge\n  Without it two controllers might "
            "command the motors at once. Restart the robot, and connect again"
        )
