"""The pilot: runs skills. Each policy tick it takes the newest state and the operator's wish and sends joint targets.

It owns nothing that could hurt: if it crashes, hangs or is killed, its last command grows old and the guardian damps.
"""

from __future__ import annotations

import math
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from sim2real.channel import Channel
from sim2real.clock import MonotonicClock, SimClock
from sim2real.config import RobotConfig
from sim2real.guardian import OBJECT, PILOT, Sink, operator_layout, request_layout
from sim2real.records import VECTOR, Layout, command_view, object_layout, pilot_layout, state_view, tick_layout
from sim2real.run import Life, RunSpec, channel, keep_time, sink, tell
from sim2real.skills import SkillPlayer
from sim2real.tracker import ObjectSample
from sim2real.types import Mode, OperatorInput

PHASE = 0.0005  # s after the guardian's tick: it has read the buses by then


class Sightings(Protocol):
    """Where sightings of the object come from."""

    def read(self, now: float) -> Sequence[ObjectSample]:
        """What has arrived by ``now`` (s) since the last call. Never waits."""
        ...


def topics(config: RobotConfig, buses: Sequence[str], player: SkillPlayer) -> dict[str, Layout]:
    """What is recorded of a run: topic -> layout, in the order of ``guardian.TICK, PILOT, OBJECT``."""
    layouts = {"/tick": tick_layout(config.joint_names, buses), "/pilot": layout_of(player)}
    return layouts | ({"/object": object_layout()} if player.tracker is not None else {})


def layout_of(player: SkillPlayer) -> Layout:
    """The Pilot layout for everything ``player`` may feed its policies."""
    inputs: dict[str, tuple[str, ...]] = {}
    for plan, policy in zip(player.plans, player.policies, strict=True):
        contract = policy.contract
        for name, array in plan.inputs.items():
            size = array.size
            known = {
                "joint_pos": contract.joint_names,
                "joint_vel": contract.joint_names,
                "skill": contract.skill_labels,
            }
            elements = known.get(name) or (VECTOR if size == 3 else tuple(f"e{i}" for i in range(size)))
            key = f"{policy.contract.name}.{name}"
            inputs[key] = tuple(elements[:size])
    return pilot_layout(player.config.joint_names, inputs, player.labels)


class Pilot:
    """Call ``tick`` at the policy rate."""

    def __init__(
        self,
        player: SkillPlayer,
        clock: MonotonicClock | SimClock,
        states: Channel,
        operator: Channel,
        requests: Channel,
        published: Channel,
        sink: Sink | None = None,
        sightings: Sightings | None = None,
    ):
        self.sightings = sightings
        self.player, self.clock = player, clock
        self.states, self.operator, self.requests, self.published, self.sink = (
            states,
            operator,
            requests,
            published,
            sink,
        )
        self.record = published.layout.new()
        self.request = requests.layout.new()
        self._state = state_view(states.record)
        self._request_view = command_view(self.request, "command")
        self._heard = False
        self._tick = 0
        self._object = object_layout().new()
        self._object["sighting.time"], self._object["sighting.position_in_base"] = -math.inf, math.nan

    def tick(self, scheduled: float, lateness: float = 0.0, late: int = 0) -> None:
        """One turn of the loop."""
        clock, player, r = self.clock, self.player, self.record
        start = clock.now()
        if self.states.read():
            self._heard = True
            self._state.time = float(self.states.record["state.time"][0])
            self._state.imu_age = float(self.states.record["state.imu_age"][0])
        self._look(start)
        wish = self._wish()
        before = clock.now()
        mode = Mode(int(self.states.record["mode"][0])) if self._heard else Mode.OFF
        command = player.step(self._state, mode, wish, start)
        after = clock.now()
        for name in ("joint_pos", "joint_vel", "joint_torque", "kp", "kd"):
            getattr(self._request_view, name)[:] = getattr(command, name)
            r[f"command.{name}"][0] = getattr(command, name)
        self.request["command.time"] = r["command.time"] = command.time
        self.request["command.object_time"] = r["command.object_time"] = command.object_time
        self.requests.write(self.request)
        r["time"], r["tick"], r["late"] = scheduled, self._tick, late
        r["stage"], r["policy"], r["skill"] = player.stage, player.policy_index, player.skill
        r["refused"] = len(player.refusals)
        r["operator.skill"] = self.operator.record["skill"][0]
        r["operator.velocity"][0] = wish.velocity
        r["operator.age"] = start - wish.time
        name = player.policies[player.policy_index].contract.name
        for signal, array in player.inputs.items():
            r[f"input.{name}.{signal}"][0] = array
        r["skill_value"][0] = player.values
        r["timing.lateness"], r["timing.policy"], r["timing.total"] = lateness, after - before, clock.now() - start
        self.published.write(r)
        if self.sink is not None:
            self.sink.write(PILOT, scheduled, r)
            self._record_object(scheduled)
        self._tick += 1

    def _look(self, now: float) -> None:
        """Hand the tracker what has arrived."""
        if self.sightings is None or self.player.tracker is None:
            return
        for sample in self.sightings.read(now):
            self.player.tracker.measure(sample)
            o = self._object
            o["sighting.time"], o["sighting.position_in_base"][0] = sample.time, sample.position_object_in_base
            o["sightings"] += 1

    def _record_object(self, scheduled: float) -> None:
        tracker, o = self.player.tracker, self._object
        if tracker is None or self.sink is None:
            return
        seen = tracker.current
        o["time"], o["tick"], o["used"] = scheduled, self._tick, tracker.counters.used
        o["position_in_base"][0], o["velocity_in_base"][0] = seen.position_in_base, seen.velocity_in_base
        o["age"], o["flying"] = seen.age, seen.flying
        self.sink.write(OBJECT, scheduled, o)

    def _wish(self) -> OperatorInput:
        self.operator.read()
        o = self.operator.record[0]
        label = self.player.labels[o["skill"]] if 0 <= o["skill"] < len(self.player.labels) else None
        return OperatorInput(
            float(o["time"]), label, tuple(o["velocity"]), bool(o["arm"]), bool(o["stop"]), bool(o["quit"])
        )


def main(directory: Path) -> int:
    """The pilot process of the run in ``directory``."""
    from sim2real.object.packet import UdpSightings
    from sim2real.policy import load_policy

    life = Life()
    spec = RunSpec.load(directory)
    config, wiring = spec.open()
    player = SkillPlayer(config, [load_policy(p, config, sha, trial=0) for p, sha in spec.policies.items()])
    joints = config.joint_names
    pilot = Pilot(
        player,
        MonotonicClock(),
        channel(directory, "tick", tick_layout(joints, [b.name for b in wiring.buses])),
        channel(directory, "operator", operator_layout()),
        channel(directory, "request", request_layout(joints)),
        channel(directory, "pilot", layout_of(player)),
        sink(spec),
        UdpSightings(socket.socket(fileno=spec.sightings)) if spec.sightings >= 0 else None,
    )
    refused = 0

    def tick(scheduled: float, lateness: float, late: int) -> None:
        nonlocal refused
        pilot.tick(scheduled, lateness, late)
        for refusal in player.refusals[refused:]:
            tell(f"refused '{refusal.skill}': {refusal.reason}")
        refused = len(player.refusals)

    keep_time(tick, player.period, spec, 70, life.goes_on, PHASE, cpu=0)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
