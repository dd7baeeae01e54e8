"""Find every joint's zero and sign by moving it by hand from stop to stop; writes the calibration that deploy demands."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from sim2real.bringup.calibrate import Motors, bare, checks, measure, rest
from sim2real.calibration import Calibration, calibration_path, is_needed, load_calibration
from sim2real.clock import MonotonicClock, SimClock
from sim2real.config import RobotConfig, Wiring, load_robot
from sim2real.options import MaybeNewFile, Positive, Seed
from sim2real.robot import open_robot
from sim2real.types import Sim2realError

ASK = {  # by the stops that can be reached
    "both": "from the middle of its range to its lower end ({low:g} rad) and hold it, then to its upper end ({high:g} rad) and hold it; then lay the limb back where it hung",
    "upper": "to its upper end ({high:g} rad), hold it, move it away, then to the same end again, and hold it there; then lay the limb back where it hung",
    "lower": "to its lower end ({low:g} rad), hold it, move it away, then to the same end again, and hold it there; then lay the limb back where it hung",
}


@dataclass
class Args:
    """Motors are off meanwhile and only asked: hang the robot up. What was measured is kept, and gone on from. Exit code 1:
    gravity or symmetry contradict it."""

    robot: str
    """a robot of configs/robots, or the path of a YAML"""
    wiring: str = ""
    """which of the robot's wirings; default: its default"""
    joint: tuple[str, ...] = ()
    """measure these anew"""
    again: bool = False
    """measure all anew"""
    out: MaybeNewFile = None
    """the calibration; default: where deploy looks for it"""
    timeout: Positive = 120.0
    """s for each joint"""
    sim: bool = False
    """simulated motors, put together in a way that only the seed knows, and a simulated person who moves the joints"""
    seed: Seed = 0
    """with --sim: how it was put together"""


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="sim2real calibrate", description=__doc__)
    config = load_robot(args.robot)
    name = args.wiring or config.default_wiring
    wiring = config.wiring(name)
    if not is_needed(wiring):
        raise Sim2realError(f"{config.name}, wiring {name}: its maker calibrated it; nothing to do")
    for joint in args.joint:
        config.indices([joint])
    path = args.out or calibration_path(config.name, name, args.sim)
    console = Console()
    motors, ask, let_go = (_simulated if args.sim else _real)(config, wiring, args.seed, console)
    calibration = _begin(path, config, name, motors, args)
    calibration = _measure(calibration, path, motors, ask, args.timeout, console)
    let_go()
    return _check(calibration, path, motors, wiring, console)


def _begin(path: Path, config: RobotConfig, name: str, motors: Motors, args: Args) -> Calibration:
    """What of an earlier calibration still holds."""
    fresh = Calibration(robot=config.name, wiring=name)
    if args.again or not path.exists():
        return fresh
    old = load_calibration(path)
    if (old.robot, old.wiring) != (fresh.robot, fresh.wiring):
        raise Sim2realError(f"{path}: of {old.robot}, wiring {old.wiring}; write elsewhere with --out, or --again")
    ranges = {j.name: j.position for j in config.joints}
    kept = [
        m for m in old.motors
        if m.joint not in args.joint and m.joint in ranges and m.position == ranges[m.joint]
        and motors.place[m.joint] == (m.bus, m.id) and motors.fingerprint[m.joint] == m.fingerprint
    ]  # fmt: skip
    return fresh.model_copy(update={"motors": kept})


def _measure(
    calibration: Calibration,
    path: Path,
    motors: Motors,
    ask: Callable[[str, str], None],
    timeout: float,
    console: Console,
) -> Calibration:
    """Joint by joint; every one is written at once."""
    joints = [j for j in motors.config.joints if calibration.motor(j.name) is None]
    if kept := len(motors.config.joints) - len(joints):
        console.print(f"{kept} joints are measured already ({path})")
    with Progress(console=console, transient=True) as progress:
        whole = progress.add_task("joints", total=len(motors.config.joints), completed=kept)
        for joint in joints:
            low, high = joint.position
            ask(joint.name, ASK[joint.reach].format(low=low, high=high))
            part = progress.add_task(joint.name, total=high - low)
            done = measure(motors, joint.name, timeout, lambda span, part=part: _show(progress, part, span))
            progress.remove_task(part)
            progress.advance(whole)
            calibration = calibration.model_copy(update={"motors": [*calibration.motors, done]})
            calibration.save(path)
    return calibration


def _show(progress: Progress, task: TaskID, span: float) -> None:
    progress.update(task, completed=span)


def _check(calibration: Calibration, path: Path, motors: Motors, wiring: Wiring, console: Console) -> int:
    """Gravity and symmetry, hands off."""
    state = rest(motors)
    contradictions = list(
        checks(motors.config, wiring.imu.site, calibration.motors, state, state.orientation_base_in_world)
    )
    calibration = calibration.model_copy(update={"checked": not contradictions})
    calibration.save(path)
    table = Table(title=f"{calibration.robot}, {calibration.wiring}", title_justify="left", box=None)
    for column in ("joint", "motor", "turns", "zero at rad", "span rad"):
        table.add_column(column, no_wrap=True, justify="left" if column in ("joint", "motor") else "right")
    for m in calibration.motors:
        table.add_row(m.joint, m.fingerprint or f"{m.bus}/{m.id}", f"{m.sign:+d}", f"{m.offset:.4f}", f"{m.span:.3f}")
    console.print(table)
    for line in motors.warnings:
        console.print(f"[yellow]know[/] {line}", highlight=False, soft_wrap=True)
    for line in contradictions:
        console.print(f"[red]contradicted[/] {line}", highlight=False, soft_wrap=True)
    if contradictions:
        console.print(f"{path}: written, and will not be accepted; measure these anew with --joint")
        return 1
    console.print(f"gravity and symmetry agree; written to {path}", soft_wrap=True)
    return 0


def _real(config: RobotConfig, wiring: Wiring, seed: int, console: Console) -> tuple[Motors, Any, Any]:
    motors = Motors(config, open_robot(config, bare(wiring)), MonotonicClock())
    ask = lambda joint, what: console.print(f"[bold]{joint}[/]: move it {what}", soft_wrap=True)  # noqa: E731
    return motors, ask, lambda: console.print("hands off: everything is to hang still, left and right alike")


def _simulated(config: RobotConfig, wiring: Wiring, seed: int, console: Console) -> tuple[Motors, Any, Any]:
    from drivers.open import open_world
    from sim2real.bringup.person import Person, assembled

    specs = assembled(wiring.bus_specs(), seed)
    home = dict(zip(config.joint_names, config.home_pos, strict=True))
    world = open_world(config.model_path, config.base, specs, wiring.imu_spec(), joint_pos=home, hang=0.3, seed=seed)
    # An arm that hangs crooked gets caught at the head; legs hang clear of everything as they are.
    limbs = {j.name: f"{j.name.partition('_')[0]} arm" if j.group == "arm" else j.name for j in config.joints}
    reach = {j.name: j.reach for j in config.joints}
    person = Person(world, {j.name: j.position for j in config.joints}, limbs, reach)
    clock = SimClock(person.advance, lambda: world.time)
    clock.sleep_until(1.0)
    motors = Motors(config, open_robot(config, bare(wiring), {**world.wires, "imu": world.imu_wire}), clock)
    return motors, lambda joint, what: person.move(joint), person.let_go
