"""Set motors up, one at a time: id, bit rate, watchdog, return delay, limits; proved to be kept, and written down."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import tyro
from rich.console import Console
from rich.progress import Progress

from drivers.bus import BusSpec, MotorSpec
from drivers.open import open_codec
from sim2real.bringup.setup import Bench, MotorList, list_path, load_list
from sim2real.clock import MonotonicClock, SimClock
from sim2real.config import load_robot
from sim2real.options import MaybeNewFile
from sim2real.types import Sim2realError


@dataclass
class Args:
    """Connect one motor of the wiring after the other, each alone on its bus. What is written down is not done again."""

    robot: str
    """a robot of configs/robots, or the path of a YAML"""
    wiring: str = ""
    """which of the robot's wirings; default: its default"""
    joint: tuple[str, ...] = ()
    """only the motors of these, also if they were set up before"""
    again: bool = False
    """all anew"""
    out: MaybeNewFile = None
    """the list of motors; default: bringup/ROBOT-WIRING.motors.yaml"""
    sim: bool = False
    """a bag of simulated motors as from the factory, and a simulated person who connects them"""


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real setup", description=__doc__)
    config = load_robot(args.robot)
    name = args.wiring or config.default_wiring
    wiring = config.wiring(name)
    config.indices(args.joint)
    specs = wiring.bus_specs()
    for spec in specs:
        open_codec(spec)  # an impossible wiring is refused before anybody connects anything
        Bench(spec, None, MonotonicClock(), lambda: None, lambda on: None).row  # noqa: B018 - and so is a protocol
    path = args.out or list_path(config.name, name, args.sim)
    motors = MotorList(robot=config.name, wiring=name)
    if path.exists() and not args.again:
        motors = load_list(path)
        if (motors.robot, motors.wiring) != (config.name, name):
            raise Sim2realError(
                f"{path}: of {motors.robot}, wiring {motors.wiring}; write elsewhere with --out, or --again"
            )
    console = Console()
    bag = Bag(config, wiring) if args.sim else None
    done = {m.joint for m in motors.motors} - set(args.joint)
    todo = [
        (s, m) for s in specs for m in s.motors if m.joint not in done and (not args.joint or m.joint in args.joint)
    ]
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("motors", total=len(todo))
        for spec, motor in todo:
            bench = bag.bench(spec, motor) if bag else _real(spec, motor, console)
            bench.show = lambda text: progress.update(task, description=text)
            record = bench.set_up(motor)
            kept = [m for m in motors.motors if m.joint != motor.joint]
            motors = motors.model_copy(update={"motors": [*kept, record]})
            motors.save(path)
            progress.advance(task)
            told = record.fingerprint
            console.print(f"[green]{motor.joint}[/]: {spec.name}/{motor.id:#x}, {told}, was {record.found_id:#x} at "
                          f"{record.found_bitrate} bit/s", highlight=False)  # fmt: skip
    console.print(f"{len(motors.motors)} motors set up; written to {path}", soft_wrap=True)
    return 0


def _real(spec: BusSpec, motor: MotorSpec, console: Console) -> Bench:
    console.print(f"[bold]{motor.joint}[/]: connect its motor ({motor.model}), and nothing else, to {spec.name} "
                  f"({spec.channel}), then press Enter", soft_wrap=True)  # fmt: skip
    console.input()

    def cycle() -> None:
        console.print("take its power away, give it back, then press Enter")
        console.input()

    def turn(on: bool) -> None:
        if on:
            console.print("turn its shaft a little by hand")

    return Bench(spec, None, MonotonicClock(), cycle, turn)


FACTORY: dict[str, dict[str, float]] = {  # by protocol, what a new motor's registers hold
    "damiao": {"ESC_ID": 1, "MST_ID": 0, "TIMEOUT": 0},
    "robstride": {"CAN_ID": 0x7F, "zero_sta": 0},
    "dynamixel": {"ID": 1, "BAUD": 1, "RETURN_DELAY": 250},
    "feetech": {"ID": 1, "BAUD": 0, "RETURN_DELAY": 0},
}
TURN_TORQUE = 2.0  # N m of a hand at a shaft


class Bag:
    """New simulated motors of a wiring, none of them connected, and a person who connects one of them."""

    def __init__(self, config: Any, wiring: Any) -> None:
        from drivers.open import open_world

        specs = wiring.bus_specs()
        registers = {m.joint: FACTORY[s.protocol] for s in specs for m in s.motors if s.protocol in FACTORY}
        self.world = open_world(config.model_path, config.base, specs, wiring.imu_spec(), registers=registers, hang=0.3)
        self.clock = SimClock(self.world.advance, lambda: self.world.time)
        for spec in specs:
            for motor in spec.motors:
                self._power(spec, motor.joint, False)

    def bench(self, spec: BusSpec, motor: MotorSpec) -> Bench:
        """The motor of a joint alone on its bus."""
        for other in spec.motors:
            self._power(spec, other.joint, other.joint == motor.joint)
        self.clock.sleep_until(self.clock.now() + 1.0)

        def cycle() -> None:
            self._power(spec, motor.joint, False)
            self.clock.sleep_until(self.clock.now() + 0.5)
            self._power(spec, motor.joint, True)

        def turn(on: bool) -> None:
            plant = self.world.plant
            sign = -1.0 if plant.joint_pos[plant.joints.index(motor.joint)] > 0 else 1.0
            plant.pull(motor.joint, (plant.weight_on(motor.joint)[0] + sign * TURN_TORQUE) * on)

        return Bench(spec, self.world, self.clock, cycle, turn)

    def _power(self, spec: BusSpec, joint: str, on: bool) -> None:
        lines = {line.spec.name: line.servos for line in getattr(self.world, "lines", ())}
        motors = lines.get(spec.name, self.world.motors)
        motors.power(motors.joints.index(joint), on, self.world.time)
