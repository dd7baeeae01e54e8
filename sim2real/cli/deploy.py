"""Run a robot: stand up, perform skills, damp. Simulated motors unless --hardware."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Collection
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from sim2real.config import RobotConfig, load_robot
from sim2real.object.camera import SIGHTS, Sight
from sim2real.operators.script import ScriptOperator, Step, parse_script
from sim2real.options import MaybeNewFile, MaybeNewGif, NotNegative, Seed, Velocity
from sim2real.types import Sim2realError


@dataclass
class Args:
    """Run a robot: stand up, perform skills, damp.

    By default the robot is simulated down to the bytes on its buses; with --hardware the same program drives real motors.
    """

    robot: str
    """a robot of configs/robots, or the path of a YAML"""
    wiring: str = ""
    """which of the robot's wirings; default: its default"""
    policy: tyro.conf.UseAppendAction[list[Path]] = field(default_factory=list)
    """policy files; default: those of --skills"""
    skills: str = ""
    """which of the sets of skills that the robot's YAML names; default: its default"""
    skill: str = ""
    """perform only this skill"""
    velocity: Velocity = (0.0, 0.0, 0.0)
    """with --skill: forward m/s, left m/s, turn rad/s"""
    duration: NotNegative = 0.0
    """with --skill: seconds; default 10"""
    script: str = ""
    """a timeline, as in "stand:3,squat:6,walk:5@0.5/0/0"; default: every skill in turn, but those that the robot's YAML has unshown"""
    operator: Literal["script", "keyboard"] = "script"
    """who picks the skill"""
    clock: Literal["realtime", "lockstep"] = "realtime"
    """lockstep: faster than real time and deterministic, simulation only"""
    seed: Seed = 0
    """of everything random in the simulation"""
    fault: tyro.conf.UseAppendAction[list[str]] = field(default_factory=list)
    """faults of the simulated wire, as in drop:0.1 or off:left_leg/left_knee_joint@8 (s; arming is at about 3)"""
    hang: bool = False
    """leave the simulated robot on its gantry: for a policy that does not balance"""
    record: Path = Path("runs")
    """where records go: a directory, or an .mcap file"""
    no_record: bool = False
    """write no record"""
    json: Annotated[MaybeNewFile, tyro.conf.arg(name="json")] = None
    """write the summary to this file"""
    video: MaybeNewGif = None
    """with lockstep: render the run to this .gif"""
    visuals: Path | None = None
    """with --video: an MJCF to show instead, such as the maker's with its meshes (joints matched by name)"""
    sightings: str = ""
    """with --hardware: UDP address at which sightings of the object are awaited, HOST:PORT; default 127.0.0.1:47201"""
    sight: Sight = "camera"
    """in simulation: what sees the object of ball skills, a camera on the robot or motion capture"""
    untuned: bool = False
    """do not ask the kernel for real-time scheduling"""
    hardware: bool = False
    """drive real motors, once everything is proved that can be (sim2real/preflight.py)"""
    calibration: Path | None = None
    """with --hardware: the calibration; default: what `sim2real calibrate` wrote for this robot and wiring"""


def main(argv: list[str]) -> int:
    args = tyro.cli(
        Args, args=argv, prog="sim2real deploy", description=__doc__, config=(tyro.conf.FlagCreatePairsOff,)
    )
    console = Console()
    config = load_robot(args.robot)
    _check(args, config)
    policies = _policies(args, config, console)
    from sim2real.skills import SkillPlayer

    player = SkillPlayer(config, policies)
    operator = _operator(args, player.labels, policies, _unshown(args, config, player.labels))
    record = None if args.no_record else _record_path(args.record, config.name)
    run = _lockstep if args.clock == "lockstep" else _realtime
    with contextlib.suppress(KeyboardInterrupt):
        summary = run(args, config, player, policies, operator, record, console)
        if args.json:
            args.json.write_text(json.dumps(summary.as_dict(), indent=1) + "\n")
        from sim2real.console import print_summary

        print_summary(console, summary)
        return 1 if summary.fell or summary.faults else 0
    return 130


def _check(args: Args, config: RobotConfig) -> None:
    if args.hardware and args.clock == "lockstep":
        raise Sim2realError("--hardware with --clock lockstep: a real robot runs in real time; drop one of the two")
    if args.hardware and args.operator != "keyboard":
        raise Sim2realError(
            "--hardware with a script: a person arms a real robot, and stops it; add --operator keyboard"
        )
    if args.hardware and (args.fault or args.video or args.hang):
        raise Sim2realError("--hardware with --fault, --video or --hang: those exist only in simulation; drop them")
    if args.calibration and not args.hardware:
        raise Sim2realError("--calibration without --hardware: simulated motors are where the YAML says; drop it")
    if args.sightings and not args.hardware:
        raise Sim2realError("--sightings without --hardware: a simulated robot has its own camera; drop it")
    if args.sight != "camera" and args.hardware:
        raise Sim2realError("--sight with --hardware: what sees the object there sends to --sightings; drop it")
    _address(args.sightings)
    if args.visuals and not args.video:
        raise Sim2realError("--visuals without --video: nothing would be shown; add --video FILE.gif")
    if args.video and args.clock != "lockstep":
        raise Sim2realError("--video in real time: rendering would make the loop late; add --clock lockstep")
    if args.operator == "keyboard" and args.clock == "lockstep":
        raise Sim2realError("--operator keyboard with --clock lockstep: nobody types that fast; use --clock realtime")
    if (args.velocity != (0.0, 0.0, 0.0) or args.duration) and not args.skill:
        raise Sim2realError("--velocity and --duration belong to one skill: add --skill, or write a --script")
    if args.skills and args.policy:
        raise Sim2realError("--skills and --policy: got both, expected one; --policy may be given more than once")
    if args.skill and args.script:
        raise Sim2realError("--skill and --script: got both, expected one")
    config.wiring(args.wiring)


def _address(text: str) -> tuple[str, int]:
    """``HOST:PORT``; empty: the default."""
    from sim2real.object.packet import ADDRESS

    host, _, port = text.rpartition(":")
    if text and not (host and port.isdecimal() and 0 < int(port) < 65536):
        raise Sim2realError(f"--sightings: got '{text}', expected HOST:PORT, e.g. 0.0.0.0:47201")
    return (host, int(port)) if text else ADDRESS


def _policies(args: Args, config: RobotConfig, console: Console):
    from sim2real.policy import load_policy

    root = Path(__file__).resolve().parents[2]
    paths = args.policy or [root / entry.file for entry in config.skill_set(args.skills)]
    policies = [load_policy(path, config) for path in paths]
    for policy in policies:
        contract = policy.contract
        console.print(
            f"[bold]{contract.name}[/] for {contract.robot}: {', '.join(contract.skill_labels)} "
            f"({1 / contract.period:.0f} Hz, {len(contract.target_joint_names)} joints, sha256 {policy.sha256[:12]})"
        )
    return policies


def _unshown(args: Args, config: RobotConfig, labels: Collection[str]) -> set[str]:
    """What the robot's YAML keeps out of the default timeline of its own policies. Raises Sim2realError for a label that
    none of them has."""
    own = [] if args.policy else config.skill_set(args.skills)
    unshown = {label for entry in own for label in entry.unshown}
    if strangers := unshown.difference(labels):
        raise Sim2realError(
            f"{config.path}: policies: unshown: got '{min(strangers)}', expected one of {', '.join(labels)}"
        )
    return unshown


def _operator(args: Args, labels: list[str], policies, unshown: Collection[str]):
    if args.operator == "keyboard":
        from sim2real.operators.keyboard import KeyboardOperator

        return KeyboardOperator(labels)
    if args.script:
        steps = parse_script(args.script)
    elif args.skill:
        steps = [Step(args.skill, args.duration or 10.0, args.velocity)]
    else:
        shown = {s.label: s for policy in policies for s in policy.contract.skills}
        rest = (
            Step(label, max(5.0, shown[label].dwell + 1.0), shown[label].velocity)
            for label in labels[1:]
            if label not in unshown
        )
        steps = [Step(labels[0], 2.0), *rest, Step(labels[0], 2.0)]
    for step in steps:
        if step.skill not in labels:
            import difflib

            close = difflib.get_close_matches(str(step.skill), labels, n=1)
            hint = f" (did you mean '{close[0]}'?)" if close else ""
            raise Sim2realError(f"skill '{step.skill}': no policy performs it{hint}; they perform {', '.join(labels)}")
    return ScriptOperator(steps)


def _record_path(where: Path, robot: str) -> Path:
    if where.suffix == ".mcap":
        return where
    return where / f"{robot}-{datetime.now():%Y%m%d-%H%M%S}.mcap"


def _calibration(args: Args, config: RobotConfig) -> Path | None:
    """The calibration that real motors need."""
    from sim2real.calibration import calibration_path, is_needed

    if not args.hardware or not is_needed(config.wiring(args.wiring)):
        return None
    return args.calibration or calibration_path(config.name, args.wiring or config.default_wiring)


def _about(args: Args, config: RobotConfig, policies) -> tuple[dict[str, object], dict[str, bytes]]:
    """Metadata and attachments that make a record self-contained."""
    import platform

    from sim2real.cli import version

    metadata = {
        "robot": config.name,
        "wiring": args.wiring or config.default_wiring,
        "clock": args.clock,
        "seed": args.seed,
        "arguments": json.dumps({k: str(v) for k, v in asdict(args).items()}),
        "skills": json.dumps([label for p in policies for label in p.contract.skill_labels]),
        "policies": json.dumps([{"file": p.path.name, "sha256": p.sha256} for p in policies]),
        "version": version(),
        "revision": _revision(),
        "python": platform.python_version(),
        "started": datetime.now().astimezone().isoformat(timespec="seconds"),
    }
    attachments = {"robot.yaml": config.path.read_bytes(), "run.json": json.dumps(metadata).encode()}
    for i, policy in enumerate(policies):
        attachments[f"{i}-{policy.path.name}"] = policy.path.read_bytes()
    return metadata, attachments


def _revision() -> str:
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        ["git", "-C", root, "describe", "--always", "--dirty"], capture_output=True, text=True, check=False
    )
    return done.stdout.strip() if done.returncode == 0 else ""


def _lockstep(args, config, player, policies, operator, record, console):
    camera = None
    if args.video:
        if not os.environ.get("DISPLAY"):
            os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo looks at this once, when it is first imported
        try:
            from drivers.sim.camera import Camera
        except (ImportError, AttributeError, OSError) as error:
            raise Sim2realError(
                f"--video: MuJoCo finds no OpenGL: {error}; install libegl1 and libgl1-mesa-dri"
            ) from None
        camera = Camera(args.video, args.visuals)
    from sim2real.clock import MonotonicClock
    from sim2real.recorder.process import Recorder
    from sim2real.simulation import Scene, Simulation

    recorder = None

    def sink_for(layouts):
        nonlocal recorder
        recorder = Recorder(record, layouts, *_about(args, config, policies), patient=True)
        return recorder.sink

    simulation = Simulation(
        config,
        policies,
        operator,
        Scene(seed=args.seed, faults=args.fault, hang=args.hang, camera=SIGHTS[args.sight]),
        args.wiring,
        sink_for if record else None,
        (lambda run: camera.see(run.world.plant)) if camera else None,
        tell=lambda text: console.print(f"  {text}", style="yellow"),
    )
    began = MonotonicClock.now()
    try:
        summary = simulation.run()
    finally:
        if recorder is not None:
            recorder.close()
    summary.real_time_factor = simulation.elapsed / (MonotonicClock.now() - began)
    if recorder is not None:
        summary.record = str(record)
    if camera is not None:
        camera.save()
        console.print(f"video {args.video}")
    return summary


def _realtime(args, config, player, policies, operator, record, console):
    from sim2real.console import Status
    from sim2real.launch import Launch
    from sim2real.operators.keyboard import KEYS
    from sim2real.pilot import topics
    from sim2real.recorder.process import Recorder

    recorder = None
    if record:
        buses = [b.name for b in config.wiring(args.wiring).buses]
        recorder = Recorder(record, topics(config, buses, player), *_about(args, config, policies))
    try:
        with Status(console, KEYS if args.operator == "keyboard" else "") as status:
            launch = Launch(
                config,
                player,
                operator,
                args.wiring,
                simulated=not args.hardware,
                calibration=_calibration(args, config),
                tune=not args.untuned,
                seed=args.seed,
                faults=args.fault,
                recorder=recorder,
                sight=args.sight,
                sightings=_address(args.sightings),
                show=status.show,
                hang=args.hang,
                timeout=10.0 if args.operator == "script" else 3600.0,
            )
            summary = launch.run()
    finally:
        if recorder is not None:
            recorder.close()
    if record:
        summary.record = str(record)
    return summary


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
