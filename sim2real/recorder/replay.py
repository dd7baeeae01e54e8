"""Push a recorded run through today's gate and policy: what would be decided otherwise?

The gate sees, tick by tick, the recorded state, request, clock and calls; the policy sees the inputs that it was fed. Both
start where the run started, so a run replays exactly unless code, limits or network changed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sim2real.config import RobotConfig
from sim2real.contract import Contract
from sim2real.policy import Policy, load_policy, read_contract
from sim2real.recorder.run import Run, rule_name
from sim2real.recorder.summary import mode_name
from sim2real.records import Calls, command_view, state_view
from sim2real.safety import Limits, Safety
from sim2real.skills import SkillPlayer, Stage, blend, blended
from sim2real.types import Sim2realError

COMMAND_FIELDS = ("joint_pos", "joint_vel", "joint_torque", "kp", "kd")


class Change(NamedTuple):
    """One thing that is decided otherwise. ``time`` in s since the run began; ``what``: mode, fault, command.kp, ..."""

    time: float
    what: str
    where: str  # joint or skill, "": of none
    was: str
    now: str


@dataclass
class Replay:
    """``changed``: what -> in how many ticks; ``first``: the first changes in full; ``largest``: what -> largest
    difference of a value."""

    ticks: int = 0
    policy_steps: int = 0
    changed: dict[str, int] = field(default_factory=dict)
    largest: dict[str, float] = field(default_factory=dict)
    first: list[Change] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def identical(self) -> bool:
        return not self.changed

    def add(self, change: Change, difference: float = 0.0, keep: int = 20) -> None:
        """Count a change, and keep it if it is among the first ``keep``."""
        self.changed[change.what] = self.changed.get(change.what, 0) + 1
        if difference:
            self.largest[change.what] = max(self.largest.get(change.what, 0.0), difference)
        if len(self.first) < keep:
            self.first.append(change)


def replay(
    run: Run,
    robot: RobotConfig | None = None,
    policies: Sequence[Path] = (),
    *,
    tolerance: float = 1e-6,
    policy_tolerance: float = 1e-4,
    keep: int = 20,
) -> Replay:
    """Compare every verdict and every target of ``run``.

    ``robot``: limits to judge by instead of the recorded ones. ``policies``: files to run instead of the recorded ones, one
    for each, with the same inputs. ``tolerance``: largest difference of a command that counts as equal (SI units);
    ``policy_tolerance``: of a joint target (rad) or skill value, the same graph on another processor. ``keep``: how many
    changes are kept in full. Raises Sim2realError where the record lacks something, or robot or policy does not fit.
    """
    robot = run.check(robot) if robot is not None else run.robot
    out = Replay()
    for name, records in (("tick", run.tick), ("policy tick", run.pilot)):
        if missing := run.missing(records):
            out.notes.append(f"{missing} {name}s are not in the record; a change behind a gap may come from it")
        if len(records) and records["tick"][0] != 0:
            out.notes.append(f"the first {records['tick'][0]} {name}s are not in the record: the replay starts late")
    with np.errstate(all="ignore"):
        for change, difference in _gate_changes(run, robot, tolerance):
            out.add(change, difference, keep)
        out.ticks = len(run.tick)
        if len(run.pilot):
            for change, difference in _policy_changes(run, robot, policies, policy_tolerance, out):
                out.add(change, difference, keep)
    return out


def _gate_changes(run: Run, robot: RobotConfig, tolerance: float) -> Iterator[tuple[Change, float]]:
    safety = Safety(Limits.of(robot))
    for i, time in enumerate(run.time.tolist()):
        row = run.tick[i : i + 1]
        now, calls = float(row["now"][0]), int(row["calls"][0])
        state, request = state_view(row), command_view(row, "request")
        if calls & Calls.ARM:
            safety.arm(state, now)
        if calls & Calls.STOP:
            safety.stop(now)
        if calls & Calls.OFF:
            safety.off()
        command = safety.step(state, request if request.time else None, now)
        if calls & Calls.STOP_AFTER:
            safety.stop(now)
        was, fault = row[0], safety.fault
        if safety.mode != was["mode"]:
            yield Change(time, "mode", "", mode_name(int(was["mode"])), safety.mode.name), 0.0
        number, joint = (fault.rule.number, fault.joint) if fault else (0, -1)
        if (number, joint) != (was["fault"], was["fault_joint"]):
            names = [rule_name(n) if n else "none" for n in (int(was["fault"]), number)]
            where = " -> ".join(filter(None, (run.joint(int(was["fault_joint"])), run.joint(joint))))
            yield Change(time, "fault", where, *names), 0.0
        for name in COMMAND_FIELDS:
            yield from _difference(
                time, f"command.{name}", run.joints, was[f"command.{name}"], getattr(command, name), tolerance
            )


def _difference(
    time: float, what: str, names: Sequence[str], was: np.ndarray, now: np.ndarray, tolerance: float
) -> Iterator[tuple[Change, float]]:
    """The largest difference of two arrays, if it is above ``tolerance``. NaN equals NaN and nothing else."""
    gap = np.abs(was - now)
    gap[(was == now) | (np.isnan(was) & np.isnan(now))] = 0.0
    worst = int(np.argmax(gap))  # NaN counts as largest
    if not gap[worst] <= tolerance:
        size = float(gap[worst]) if np.isfinite(gap[worst]) else float("inf")
        yield Change(time, what, names[worst], f"{was[worst]:.7g}", f"{now[worst]:.7g}"), size


def _policy_changes(
    run: Run, robot: RobotConfig, files: Sequence[Path], tolerance: float, out: Replay
) -> Iterator[tuple[Change, float]]:
    recorded, policies = _policies(run, robot, files)
    current, since = -1, -np.inf  # policy that runs; when the blend from another one's targets began
    before = blend_from = np.zeros(len(robot.joint_names))
    parts = blended(robot)
    first_label = np.cumsum([0, *(len(contract.skills) for contract in recorded)])
    for row, time in zip(run.pilot, run.pilot_time.tolist(), strict=True):
        index = int(row["policy"]) if row["stage"] == Stage.RUN else -1
        target, now = row["command.joint_pos"], float(row["command.time"])
        if index >= len(policies):
            raise Sim2realError(f"{run.path}: policy {index} at {time:.2f} s, but it has {len(policies)} policy files")
        if index >= 0:
            policy, contract = policies[index], policies[index].contract
            if index != current:
                policy.reset()
                since = now if current >= 0 else -np.inf
                blend_from = before
            prefix = f"input.{recorded[index].name}."
            inputs = {name: row[prefix + name] for name in policy.signals}
            if all(np.isfinite(x).all() for x in inputs.values()):
                outputs = policy.step(inputs)
                out.policy_steps += 1
                joints = robot.indices(contract.target_joint_names)
                wanted = outputs["joint_pos_target"].astype(float)
                share = (now - since) / SkillPlayer.blend_time
                if share < 1.0:
                    wanted = blend(wanted, blend_from[joints], share, parts[joints])
                names = contract.target_joint_names
                yield from _difference(time, "joint_pos_target", names, target[joints], wanted, tolerance)
                if "skill_value" in outputs:
                    labels = contract.skill_labels
                    values = row["skill_value"][first_label[index] :][: len(labels)]
                    yield from _difference(
                        time, "skill_value", labels, values, outputs["skill_value"].astype(float), tolerance
                    )
        current, before = index, target


class _Runnable(NamedTuple):
    """A policy and the names of the signals that it is fed."""

    policy: Policy
    signals: tuple[str, ...]

    @property
    def contract(self) -> Contract:
        return self.policy.contract

    def reset(self) -> None:
        self.policy.reset()

    def step(self, inputs: dict[str, np.ndarray]):
        return self.policy.step(inputs)


def _policies(run: Run, robot: RobotConfig, files: Sequence[Path]) -> tuple[list[Contract], list[_Runnable]]:
    """What the recorded policies say of themselves, and those to run: ``files``, or the recorded ones.

    Raises Sim2realError where they do not match."""
    with tempfile.TemporaryDirectory() as folder:
        kept = []
        for content in (c for name, c in run.reader.attachments.items() if name.endswith(".onnx")):
            kept.append(Path(folder) / f"{len(kept)}.onnx")
            kept[-1].write_bytes(content)
        if not kept:
            raise Sim2realError(f"{run.path}: no policy file in the record; its policy cannot be replayed")
        if files and len(files) != len(kept):
            raise Sim2realError(
                f"--policy: got {len(files)} files, expected {len(kept)}, one for each policy of the run"
            )
        recorded = [read_contract(path) for path in kept]
        for old, path in zip(recorded, files, strict=False):
            _comparable(path, read_contract(path), old)
        return recorded, [_runnable(load_policy(path, robot)) for path in files or kept]


def _comparable(path: Path, new: Contract, old: Contract) -> None:
    """Raise Sim2realError unless ``new`` can be fed what ``old`` was fed."""
    for what in ("joint_names", "skill_labels", "period"):
        got, expected = getattr(new, what), getattr(old, what)
        if got != expected:
            raise Sim2realError(
                f"{path}: {what}: got {got}, expected {expected} as in the recorded '{old.name}';"
                " only a policy that sees the same can be compared"
            )
    if strangers := [n for n in new.inputs if n not in old.inputs and n not in new.carry]:
        raise Sim2realError(
            f"{path}: inputs {', '.join(strangers)} were not recorded; the run has {', '.join(old.inputs)}"
        )


def _runnable(policy: Policy) -> _Runnable:
    contract = policy.contract
    return _Runnable(policy, tuple(n for n in contract.inputs if n not in contract.carry))
