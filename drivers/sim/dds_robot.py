"""An emulated factory G1 behind its DDS topics: LowCmd in, LowState out, and the service that owns its controllers.

Decoded with the same codec as the host's side. The PD law of every motor runs inside the plant's integrator in every
substep, from the moment its LowCmd arrived on. While one of the maker's controllers is in charge (as after switching on)
LowCmd is ignored, and so is one whose CRC or ``mode_machine`` is wrong, without a word, as on the robot.

When LowCmd stops, the last one stays in force for ever. Nobody has published what a G1 does then; this is the worst case.
Not modelled: the maker's controllers (motors are limp meanwhile), temperatures, voltages, the remote, the parallel ankles
(``mode_pr`` is taken as 0), errors of motors other than a missing supply.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from drivers.bus import BusError, BusSpec
from drivers.codecs import unitree_api as api
from drivers.codecs import unitree_hg as hg
from drivers.sim.motor import AMBIENT, DAMPING, DRIVING, EFFECTS, LIMP, OFF, Body, MotorEvent

Message = tuple[str, bytes]  # topic, payload


class SimG1:
    """The motors of ``spec`` on the joints of ``body`` (which has the same order).

    ``mode_machine``: which variant it says it is. ``controller``: the maker's controller in charge at first, "": none;
    ``stubborn``: how many requests to release it are ignored.
    """

    speaks = False  # in CAN frames; LowState is StatePublisher's

    def __init__(
        self, spec: BusSpec, body: Body, *, mode_machine: int = 5, controller: str = "ai", stubborn: int = 0
    ) -> None:
        hg.UnitreeHgCodec(spec)  # refuses a wiring that no G1 has
        n = len(spec.motors)
        self.spec, self.mode_machine, self.controller, self.stubborn = spec, mode_machine, controller, stubborn
        self.joints = [m.joint for m in spec.motors]
        self.bus_names = [spec.name] * n
        self.log: list[MotorEvent] = []
        self.enabled = np.zeros(n, bool)
        self.powered = [True] * n
        self.last_command_time = np.full(n, -np.inf)
        self.ignored = 0  # LowCmds
        self._body = body
        self._slots = np.array([m.id for m in spec.motors])
        self._sign = np.array([m.sign for m in spec.motors], float)
        self._offset = np.array([m.offset for m in spec.motors])
        self._command = np.zeros(1, hg.COMMAND)
        self._law = np.zeros((3, n))  # bias, kp, kd at the joints
        self._arrived: list[tuple[float, np.ndarray]] = []  # laws since the last substep, with their time
        self._effect = np.full(n, OFF)
        self._settle = False  # the body still has the mean of several laws
        body.limit(np.array([hg.MODELS[m.model].torque for m in spec.motors]))

    def receive(self, topic: str, payload: bytes, time: float) -> list[Message]:
        """A sample that arrived at ``time``; what the robot publishes in answer."""
        if topic == api.MOTION_REQUEST:
            return self._serve(payload)
        frame = hg.read_command(payload) if topic == hg.COMMAND_TOPIC else None
        if frame is None or self.controller or frame["mode_machine"][0] != self.mode_machine:
            self.ignored += 1
            return []
        self._command = frame
        self._obey(time)
        return []

    def _obey(self, time: float) -> None:
        """Let the last LowCmd be in force from ``time`` on."""
        motors = self._command["motors"][0][self._slots]
        on = (motors["mode"] == hg.ENABLED) & np.array(self.powered)
        q, dq, tau, kp, kd = (motors[name].astype(float) for name in ("q", "dq", "tau", "kp", "kd"))
        bias = self._sign * (kp * (q - self._offset) + kd * dq + tau)
        self.last_command_time[on] = time
        self._change(on, np.where(kp > 0, DRIVING, np.where(kd > 0, DAMPING, LIMP)), time)
        self._arrived.append((time, np.array([bias, kp, kd]) * on))

    def _change(self, on: np.ndarray, effect: np.ndarray, time: float) -> None:
        for row in np.flatnonzero(on != self.enabled):
            self.log.append(MotorEvent(time, self.spec.name, self.joints[row], "enabled" if on[row] else "disabled"))
        effect = np.where(on, effect, OFF)
        for row in np.flatnonzero((effect != self._effect) & on):
            self.log.append(MotorEvent(time, self.spec.name, self.joints[row], EFFECTS[effect[row]]))
        self.enabled, self._effect = on, effect

    def _serve(self, payload: bytes) -> list[Message]:
        """The motion switcher."""
        if (request := api.unpack_request(payload)) is None:
            return []
        data = ""
        if request.api == api.CHECK_MODE:
            data = json.dumps({"form": "0", "name": self.controller})
        elif request.api == api.RELEASE_MODE:
            if self.stubborn:
                self.stubborn -= 1
            else:
                self.controller = ""
        code = (
            0 if request.api in (api.CHECK_MODE, api.RELEASE_MODE) else 3203
        )  # "not implemented" in the maker's table
        return [(api.MOTION_RESPONSE, api.pack_response(api.Response(request.id, request.api, code, data)))]

    def act(self, start: float, end: float) -> None:
        """Set the body's drive for the substep from ``start`` to ``end``: the mean over it of the laws in force."""
        if self._arrived:
            mean, since = np.zeros_like(self._law), start
            for time, law in self._arrived:
                mean += self._law * (max(time, start) - since)
                self._law, since = law, max(time, start)
            mean += self._law * (end - since)
            self._body.drive(*(mean / (end - start)))
            self._arrived.clear()
            self._settle = True
        elif self._settle:
            self._body.drive(*self._law)
            self._settle = False

    def power(self, row: int, on: bool, time: float) -> None:
        """Take a motor's supply away, or give it back; it obeys again with the next LowCmd."""
        if self.powered[row] != on:
            self.powered[row] = on
            event = "powered on" if on else "powered off"
            self.log.append(MotorEvent(time, self.spec.name, self.joints[row], event))
            self._obey(time)

    def state(self, imu: Sequence[np.ndarray], time: float) -> bytes:
        """The LowState at ``time``. ``imu``: quaternion (w, x, y, z), rad/s, m/s^2. A motor without supply says what a
        dead one says: nothing but zeros, under-voltage and mode 0."""
        body, powered = self._body, np.array(self.powered)
        fields = np.zeros((6, hg.SLOTS))
        fields[:, self._slots] = (
            self.enabled,
            (self._sign * body.joint_pos + self._offset) * powered,
            self._sign * body.joint_vel * powered,
            self._sign * body.joint_torque * powered,
            np.full(len(powered), AMBIENT),
            np.where(powered, 0, 0x8),
        )
        return hg.pack_state(list(fields), imu, round(time * 1000), self.mode_machine)


def only_bus(buses: Sequence[BusSpec]) -> BusSpec:
    """The one bus of a robot behind DDS. Raises BusError where there are others."""
    if len(buses) != 1:
        raise BusError(
            f"got buses {', '.join(b.name for b in buses)}; expected one: a simulated robot behind DDS has no others"
        )
    return buses[0]
