"""A whole run in one process and in lockstep: the production classes on a simulated clock, faster than real time.

Everything above the wire is what runs on a robot. Only time is different: the guardian's sleep advances the world, and the
pilot ticks between the guardian's sensing and acting, where a process of its own would have answered too. Same seed, same
bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from drivers.open import open_world
from sim2real.channel import Channel
from sim2real.clock import Schedule, SimClock
from sim2real.config import RobotConfig
from sim2real.guardian import Guardian, Sink, operator_layout, request_layout
from sim2real.object.camera import CameraModel, SimCamera
from sim2real.object.scene import Handover, TrueObject, prepare_for, starts_of
from sim2real.operators import Operator, store
from sim2real.pilot import Pilot, topics
from sim2real.records import Layout
from sim2real.robot import open_robot
from sim2real.safety import Limits, Safety
from sim2real.skills import Runnable, SkillPlayer, Stage, object_for
from sim2real.summary import Measures, Summary

SETTLE = 3.0  # s: a limp robot on its gantry swings for a while before anybody switches it on

LOWERING = 0.55  # s at 0.1 m/s: feet touch, and the rope still carries about half of the weight
LETTING_GO = 0.3  # s after the policy took over


@dataclass
class Scene:
    """What a simulation is besides the robot: randomness, faults, and what happens to the body.

    ``prepare(spec)`` alters the MuJoCo model before it is compiled. ``pushes``: (seconds since the policy took over,
    velocity change of the base (3,) m/s). ``camera``: what sees the object of ball skills; None: nothing does, and policies
    are fed the truth. ``ball``: its radius, mass, restitution where they shall not be those it was trained with.
    """

    seed: int = 0
    faults: Sequence[str] = ()
    prepare: Callable | None = None
    pushes: Sequence[tuple[float, tuple[float, float, float]]] = ()
    gantry: bool = True  # it begins hanging; False: standing
    hang: bool = False  # and nobody sets it down
    noise: float = 0.02  # rad, uniform, on the joints it starts from
    timestep: float = 0.002  # s
    camera: CameraModel | None = CameraModel()
    ball: Mapping[str, float] = field(default_factory=dict)


@dataclass
class Simulation:
    """Build it, then ``run()``. ``each_tick(simulation)`` is called after every guardian tick (rendering, probes)."""

    config: RobotConfig
    policies: Sequence[Runnable]
    operator: Operator
    scene: Scene = field(default_factory=Scene)
    wiring: str = ""
    sink_for: Callable[[dict[str, Layout]], Sink] | None = None  # topic -> layout
    each_tick: Callable[[Simulation], None] | None = None
    tell: Callable[[str], None] = lambda text: None
    timeout: float = 10.0  # s to be armed and through the soft start

    def __post_init__(self) -> None:
        wiring = self.config.wiring(self.wiring)
        scene = self.scene
        contracts = [policy.contract for policy in self.policies]
        thing = object_for(contracts)
        self.world = open_world(
            self.config.model_path,
            self.config.base,
            wiring.bus_specs(),
            wiring.imu_spec(),
            timestep=scene.timestep,
            seed=scene.seed,
            faults=scene.faults,
            prepare=_both(scene.prepare, prepare_for(thing, scene.timestep, **scene.ball)),
            joint_pos=dict(zip(self.config.joint_names, self.config.home_pos, strict=True)),
            hang=0.02 if scene.gantry else None,
            noise=scene.noise,
        )
        self.clock = SimClock(self.world.advance, self.world.now)
        joints = self.config.joint_names
        truth = TrueObject(self.world, thing.radius) if thing and scene.camera is None else None
        player = SkillPlayer(self.config, self.policies, truth)
        layouts = topics(self.config, [b.name for b in wiring.buses], player)
        states, operator = Channel(layouts["/tick"]), Channel(operator_layout())
        requests, published = Channel(request_layout(joints)), Channel(layouts["/pilot"])
        sink = self.sink_for(layouts) if self.sink_for else None
        self.camera = SimCamera(scene.camera, scene.seed) if thing and scene.camera else None
        self.handover = Handover(self.world, starts_of(contracts)) if thing else None
        self.robot = open_robot(self.config, wiring, {**self.world.wires, "imu": self.world.imu_wire})
        self.safety = Safety(Limits.of(self.config))
        period = 1.0 / wiring.rate
        self.guardian = Guardian(
            self.robot, self.safety, self.clock, period, requests, operator, states, sink, self._tell
        )
        self.pilot = Pilot(player, self.clock, states, operator, requests, published, sink, self.camera)
        self.player = player
        self._operator_channel = operator
        self._operator_record = operator.layout.new()
        self.every = round(player.period / period)
        self.schedule = Schedule(self.clock, period)
        self.since = -1.0  # s since the policy took over; negative before
        self.elapsed = 0.0  # s of simulated time, from connecting to the end
        self.messages: list[str] = []
        self.measures = Measures(self.config, wiring, player)

    def _tell(self, text: str) -> None:
        self.messages.append(text)
        self.tell(text)

    def run(self) -> Summary:
        """Connect, arm, perform the operator's timeline, damp, switch off. Raises BusError if a motor is missing."""
        world = self.world
        world.advance(SETTLE)
        self.robot.connect(self.clock)
        self.schedule.start()
        began = self.clock.now()
        running: float | None = None
        pushes = list(self.scene.pushes)
        hanging = self.scene.gantry and not self.scene.hang
        while not self.guardian.done:
            due = self.schedule.wait()
            now = self.clock.now()
            stage = self.player.stage
            if running is None and stage == Stage.RUN:
                running = now
            self.since = now - running if running is not None else -1.0
            wish = self.operator.read(now, self.since)
            if hanging:
                hanging = support(world, stage, self.player.engage_left(now), self.since)
            if self.handover is not None:
                label = self.player.labels[self.player.skill]
                self.handover.act(stage, label, self.player.engage_left(now), self.since, wish.skill)
            if self.camera is not None:
                self.camera.watch(world)
            while pushes and 0 <= pushes[0][0] <= self.since:
                world.push(pushes.pop(0)[1])
            if self.player.object_age > self.player.object_patience:
                wish = replace(wish, arm=False)  # whoever arms looks first whether it sees its ball
            store(wish, self.player.labels, self._operator_record)
            self._operator_channel.write(self._operator_record)
            self.guardian.sense(due, self.schedule.lateness, self.schedule.late)
            if self.guardian.record["tick"][0] % self.every == 0:
                self.pilot.tick(due)
            self.clock.sleep_until(due + self.guardian.response)
            self.guardian.act()
            if self.guardian.record["tick"][0] % self.every == 0:
                self.measures.observe(world, self.guardian.record, self.pilot.record, self.since)
            self.measures.tick(self.guardian.record)
            if self.each_tick is not None:
                self.each_tick(self)
            if running is None and now - began > self.timeout:
                running = now
                self._tell(f"the policy never took over within {self.timeout:g} s")
                self.guardian.quit()
        self.clock.sleep_until(self.clock.now() + 0.01)  # the last frames are still on the wire
        summary = self.measures.summary(self.messages, self.player, wire_sha256=world.digest)
        self.elapsed = self.clock.now() - began
        self.robot.close()
        self.operator.close()
        return summary


def _both(*parts: Callable[[Any], None] | None) -> Callable[[Any], None] | None:
    """One ``prepare`` after the other."""
    chosen = [part for part in parts if part is not None]

    def prepare(spec: Any) -> None:
        for part in chosen:
            part(spec)

    return prepare if chosen else None


def support(crane, stage: Stage, left: float, since: float) -> bool:
    """What the person at the crane does: in the last of the soft start (``left`` s) sets the robot on its feet without
    giving it all its weight, and lets go once the policy has had it for a moment (``since`` s). Returns whether there is
    still something to do."""
    if stage == Stage.ENGAGE and left < LOWERING:
        crane.lower()
    elif since > LETTING_GO:
        crane.release()
    elif since >= 0:
        crane.hold()
    return since <= LETTING_GO
