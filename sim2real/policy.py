"""Policies: load a file, prove that it is what it says and fits this robot, and step it.

``load_policy`` refuses before anything can move: bytes -> sha256 -> parse, seal, operators -> metadata -> graph against
metadata -> metadata against robot -> golden replay and warm-up, first in a short-lived process with a time and a memory
limit (a hanging or exploding graph must not take the program with it), then here. Every refusal is a PolicyError.
"""

from __future__ import annotations

import hashlib
import json
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import ValidationError

from sim2real.config import RobotConfig, did_you_mean, explain
from sim2real.contract import CARRY, METADATA_KEY, Contract
from sim2real.graph import MAX_BYTES, PolicyError, metadata, parse, tensors
from sim2real.skills import MEASURED

__all__ = ["Mismatch", "Policy", "PolicyError", "load_policy", "mismatches", "read_contract", "refuse_mismatches"]

TRIAL_SECONDS = 20.0  # a policy needs well below one, most of it the start of Python
TRIAL_BYTES = 8 * 2**30  # of address space, of which onnxruntime reserves much and touches little
WARM_UP = 20  # steps
POSITION_SLACK = 0.1  # rad beyond a joint's range that a recorded position may be: simulated limits are soft


class Policy:
    """A loaded policy. One thread, no allocation per step: tensors are bound once and reused."""

    def __init__(self, data: bytes, contract: Contract, path: Path = Path()) -> None:
        """``data``: the whole file, already checked. Raises PolicyError if onnxruntime cannot run it."""
        import onnxruntime

        self.contract = contract
        self.path = path
        self.sha256 = hashlib.sha256(data).hexdigest()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.enable_mem_reuse = False  # a place of its own for every intermediate: a twentieth faster
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 4  # failures are raised; nothing else is news
        try:
            self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's exceptions share no base class
            raise PolicyError(
                f"{path}: onnxruntime {onnxruntime.__version__} refuses the graph: {' '.join(str(error).split())[:300]};"
                " export it again with a lower opset, or update onnxruntime"
            ) from None
        inputs = {n: np.zeros((1, *shape), np.float32) for n, shape in contract.inputs.items()}
        outputs = {n: np.zeros((1, *shape), np.float32) for n, shape in contract.outputs.items()}
        self._binding = self._session.io_binding()
        # These OrtValues share memory with the arrays: writing an array is feeding the graph.
        for name, array in inputs.items():
            self._binding.bind_ortvalue_input(name, onnxruntime.OrtValue.ortvalue_from_numpy(array))
        for name, array in outputs.items():
            self._binding.bind_ortvalue_output(name, onnxruntime.OrtValue.ortvalue_from_numpy(array))
        self._signals = {n: a[0] for n, a in inputs.items() if not n.startswith(CARRY)}
        self._carries = [(inputs[n], outputs[f"{n}_next"]) for n in contract.carry]
        self._starts = {
            n: (inputs[n], np.reshape(np.asarray(c.start, np.float32), inputs[n].shape) if c.start else 0.0)
            for n, c in contract.carry.items()
        }
        self._outputs = {n: a[0] for n, a in outputs.items()}
        self.joint_pos_target = self._outputs["joint_pos_target"]  # (targets,) rad, of the latest step
        self.skill_value = self._outputs.get("skill_value")  # (skills,) of the latest step, or None
        self.golden_error = float("nan")  # largest error of the golden replay, once ``prove`` ran
        self.reset()

    def reset(self, carries: Mapping[str, np.ndarray] | None = None) -> None:
        """Start over: every carry at its stated start, or as ``carries`` has it (by name, without the batch axis)."""
        for name, (carry, start) in self._starts.items():
            carry[...] = start if carries is None or name not in carries else carries[name]

    @property
    def carries(self) -> Mapping[str, np.ndarray]:
        """What the next step will be told of this one, by name, without the batch axis."""
        return {name: carry[0] for name, (carry, _) in self._starts.items()}

    def step(self, inputs: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """One policy period.

        ``inputs``: every signal of the contract by name, shape without the batch axis, SI units, any float type; others
        are ignored. Returns every output, float32, the same arrays each call: copy what you keep. Raises PolicyError
        for an absent signal, ValueError for a wrong shape.
        """
        for name, array in self._signals.items():
            if name not in inputs:
                raise PolicyError(
                    f"{self.path}: step: no input '{name}', expected {', '.join(self._signals)}; this robot does not"
                    " provide that signal"
                )
            given = inputs[name]
            if np.shape(given) != array.shape:  # numpy would spread a single value over all
                raise ValueError(f"{self.path}: step: '{name}' has shape {np.shape(given)}, expected {array.shape}")
            array[...] = given
        self._session.run_with_iobinding(self._binding)
        for carry, after in self._carries:
            carry[...] = after
        return self._outputs

    def prove(self) -> None:
        """Replay every golden sequence, then warm up and reset. Raises PolicyError naming the first wrong value."""
        self.golden_error = 0.0
        for k, golden in enumerate(self.contract.golden):
            inputs = {n: np.asarray(rows, np.float32) for n, rows in golden.inputs.items()}
            expected = {n: np.asarray(rows, np.float32) for n, rows in golden.outputs.items()}
            self.reset()
            for t in range(golden.steps):
                outputs = self.step({n: np.reshape(rows[t], self._signals[n].shape) for n, rows in inputs.items()})
                for name, rows in expected.items():
                    error = np.abs(outputs[name].ravel() - rows[t])
                    i = int(np.argmax(error))  # NaN counts as largest
                    if not error[i] <= self.contract.golden_tolerance:
                        raise PolicyError(
                            f"{self.path}: golden[{k}] step {t}, {name}[{i}]: got {outputs[name].ravel()[i]:.7g},"
                            f" expected {rows[t][i]:.7g} within {self.contract.golden_tolerance:g}; this graph does not"
                            " compute what was recorded at export: export it again, or compare the onnxruntime versions"
                        )
                    self.golden_error = max(self.golden_error, float(error[i]))
        rest = {n: np.asarray(rows[0], np.float32) for n, rows in self.contract.golden[0].inputs.items()}
        for _ in range(WARM_UP):
            self.step({n: np.reshape(row, self._signals[n].shape) for n, row in rest.items()})
        self.reset()


class Mismatch(NamedTuple):
    """One way in which a policy does not fit a robot."""

    what: str
    got: str
    expected: str
    fix: str

    def __str__(self) -> str:
        return f"{self.what}: got {self.got}, expected {self.expected}; {self.fix}"


def load_policy(
    path: str | Path,
    robot: RobotConfig | None = None,
    sha256: str | None = None,
    *,
    trial: float = TRIAL_SECONDS,
) -> Policy:
    """Read, check, prove and warm up a policy file.

    ``robot``: refuse a policy that does not fit it. ``sha256``: refuse any other file. ``trial``: seconds that the first
    execution, in a process of its own, may take; 0: no trial, for files already proved. Raises PolicyError.
    """
    path = Path(path)
    data = _read(path)
    digest = hashlib.sha256(data).hexdigest()
    if sha256 and sha256.lower() != digest:
        raise PolicyError(f"{path}: got sha256 {digest}, expected {sha256}; it is another file, or was changed")
    contract = _read_contract(data, str(path))
    if robot is not None:
        refuse_mismatches(contract, robot, str(path))
    if trial:
        _try(data, path, trial)
    policy = Policy(data, contract, path)
    policy.prove()
    return policy


def read_contract(path: str | Path) -> Contract:
    """What a policy file says about itself, checked against its graph; nothing is executed. Raises PolicyError."""
    return _read_contract(_read(Path(path)), str(path))


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(MAX_BYTES + 1)  # one more, and ``parse`` says that it is too large
    except OSError as error:
        near = sorted(p.name for p in path.parent.glob("*.onnx")) if path.parent.is_dir() else []
        hint = did_you_mean(path.name, near) or (f"; here are {', '.join(near)}" if near else "")
        raise PolicyError(f"{path}: {error.strerror}, expected a policy file (.onnx){hint}") from None


def _read_contract(data: bytes, where: str) -> Contract:
    model = parse(data, where)
    found = metadata(model)
    try:
        contract = Contract.model_validate_json(found[METADATA_KEY], strict=True)
    except ValidationError as error:
        raise PolicyError(explain(f"{where}: {METADATA_KEY}", error, Contract)) from None
    if "joint_names" in found and (csv := found["joint_names"].split(",")) != contract.target_joint_names:
        raise PolicyError(
            f"{where}: metadata: got joint_names {csv}, expected {contract.target_joint_names} as in '{METADATA_KEY}';"
            " two readers of this file would move different joints: export it again"
        )
    initializers = {t.name for t in model.graph.initializer}
    sides = (
        ("input", contract.inputs, tensors(v for v in model.graph.input if v.name not in initializers)),
        ("output", contract.outputs, tensors(model.graph.output)),
    )
    for side, stated, present in sides:
        for name in sorted({*stated, *present}):
            if name not in stated or name not in present:
                here, there = ("graph", "metadata") if name in present else ("metadata", "graph")
                raise PolicyError(
                    f"{where}: {side} '{name}': got it in the {here} only, expected it in the {there} too; export it again"
                )
            if present[name] != (wanted := ("float32", [1, *stated[name]])):
                raise PolicyError(
                    f"{where}: {side} '{name}': got {_tensor(*present[name])} in the graph,"
                    f" expected {_tensor(*wanted)} as its metadata says; export it again"
                )
    return contract


def _tensor(kind: str, shape: Sequence[int | str]) -> str:
    return f"{kind}[{', '.join(map(str, shape))}]"


def _try(data: bytes, path: Path, seconds: float) -> None:
    """Prove the policy in a process of its own, limited in time and memory."""
    start = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from sim2real.policy import _trial; _trial()"
    command = [sys.executable, "-c", start, json.dumps(sys.path), str(path)]
    try:
        done = subprocess.run(command, input=data, capture_output=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        raise PolicyError(
            f"{path}: golden replay: got no answer within {seconds:g} s, expected well below 1 s; the graph hangs or is"
            " too large for this machine: export a smaller one"
        ) from None
    if done.returncode == 1 and done.stdout:
        raise PolicyError(done.stdout.decode(errors="replace"))
    if done.returncode:
        said = " ".join(done.stderr.decode(errors="replace").split())[-200:]
        raise PolicyError(
            f"{path}: golden replay: its process ended with status {done.returncode} ({said}), expected 0; the graph"
            " crashes onnxruntime or takes too much memory: export it again"
        )


def _trial() -> None:
    """The process of ``_try``: file on stdin, its name in argv; exit status 0, or 1 and the refusal on stdout."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if sys.platform == "linux":
        resource.setrlimit(resource.RLIMIT_AS, (TRIAL_BYTES, TRIAL_BYTES))
    data, path = sys.stdin.buffer.read(), Path(sys.argv[2])
    try:
        Policy(data, _read_contract(data, str(path)), path).prove()
    except PolicyError as error:
        sys.stdout.write(str(error))
        sys.exit(1)
    except Exception as error:  # onnxruntime's exceptions share no base class
        said = " ".join(str(error).split())[:300]
        sys.stdout.write(f"{path}: golden replay: onnxruntime fails ({said}), expected outputs; export it again")
        sys.exit(1)


def mismatches(contract: Contract, robot: RobotConfig) -> list[Mismatch]:
    """Every way in which a policy does not fit a robot; empty: it fits."""
    strangers = list(_strangers(contract, robot))
    # With foreign joint names the checks by joint have nothing to compare with.
    checks = CHECKS if not strangers else (_identity, _signals, _period)
    return [*strangers, *(m for check in checks for m in check(contract, robot))]


def refuse_mismatches(contract: Contract, robot: RobotConfig, where: str) -> None:
    """Raise PolicyError with every mismatch, if there is one."""
    if found := mismatches(contract, robot):
        lines = "\n".join(f"  {m}" for m in found)
        raise PolicyError(f"{where}: policy '{contract.name}' does not fit robot '{robot.name}':\n{lines}")


def _strangers(contract: Contract, robot: RobotConfig) -> Iterator[Mismatch]:
    for what in ("joint_names", "target_joint_names", "hold"):
        for name in getattr(contract, what):
            if name not in robot.joint_names:
                hint = did_you_mean(name, robot.joint_names)
                yield Mismatch(
                    what, f"'{name}'", f"a joint of {robot.name}{hint}", "export with this robot's joint names"
                )


def _identity(contract: Contract, robot: RobotConfig) -> Iterator[Mismatch]:
    if contract.robot != robot.name:
        yield Mismatch("robot", f"'{contract.robot}'", f"'{robot.name}'", "choose a policy trained for this robot")
    if contract.variants and robot.variants and not set(contract.variants) & set(robot.variants):
        fix = "gains and limits differ between hardware variants: choose a policy trained for this one"
        yield Mismatch("variants", str(contract.variants), f"one of {robot.variants}", fix)


def _covers(contract: Contract, robot: RobotConfig) -> Iterator[Mismatch]:
    for name in robot.joint_names:
        if name not in contract.target_joint_names and name not in contract.hold:
            fix = "say in hold at which position and with which gains it stays"
            yield Mismatch(f"hold.{name}", "nothing", "every joint either driven or held", fix)


def _gains(contract: Contract, robot: RobotConfig) -> Iterator[Mismatch]:
    driven = zip(contract.target_joint_names, contract.kp, contract.kd, strict=True)
    held = ((name, hold.kp, hold.kd) for name, hold in contract.hold.items())
    for where, rows in (("", driven), ("hold.", held)):
        for name, kp, kd in rows:
            joint = robot.joints[robot.joint_names.index(name)]
            for gain, got, most in (("kp", kp, joint.kp_max), ("kd", kd, joint.kd_max)):
                if got > most:
                    fix = f"train with a lower {gain}, or raise {gain}_max in {robot.name}.yaml if the motor permits"
                    yield Mismatch(f"{where}{gain}.{name}", f"{got:g}", f"at most {most:g}", fix)


def _positions(contract: Contract, robot: RobotConfig) -> Iterator[Mismatch]:
    """Stated and recorded positions lie in their joints' ranges; joints in a wrong order seldom do."""
    margin = robot.safety.position_margin
    seen = np.concatenate(
        [np.asarray(g.inputs["joint_pos"]) for g in contract.golden if "joint_pos" in g.inputs] or [[]]
    )
    columns = zip(*seen, strict=True) if seen.size else [[]] * len(contract.joint_names)
    rows = [
        *((f"default_joint_pos.{n}", n, [p], margin) for n, p in zip(contract.joint_names, contract.default_joint_pos, strict=True)),
        *((f"hold.{n}.position", n, [h.position], margin) for n, h in contract.hold.items()),
        *((f"golden joint_pos.{n}", n, c, -POSITION_SLACK) for n, c in zip(contract.joint_names, columns, strict=True)),
    ]  # fmt: skip
    for what, name, values, inside in rows:
        low, high = robot.joints[robot.joint_names.index(name)].position
        outside = [v for v in values if not low + inside <= v <= high - inside]
        if outside:
            worst = max(outside, key=lambda v, centre=(low + high) / 2: abs(v - centre))
            fix = "check that joint_names has the order, sign and zero of the graph"
            yield Mismatch(what, f"{worst:.4g} rad", f"{low + inside:.4g} to {high - inside:.4g}", fix)


def _signals(contract: Contract, robot: RobotConfig) -> Iterator[Mismatch]:
    for name in contract.inputs:
        if not name.startswith(CARRY) and name not in MEASURED:
            fix = "train without it, or estimate it inside the graph from signals that are measured"
            yield Mismatch(f"inputs.{name}", "a signal nothing measures", f"one of {', '.join(MEASURED)}", fix)


def _period(contract: Contract, robot: RobotConfig) -> Iterator[Mismatch]:
    rate = robot.wiring().rate
    ticks = contract.period * rate
    if round(ticks) < 1 or abs(ticks - round(ticks)) > 1e-6 * ticks:
        whole = max(1, round(ticks))
        fix = f"a wiring rate of {whole / contract.period:g} Hz would fit"
        yield Mismatch("period", f"{contract.period:g} s", f"a whole number of ticks of 1/{rate:g} s", fix)


CHECKS: tuple[Callable[[Contract, RobotConfig], Iterator[Mismatch]], ...] = (
    _identity, _signals, _covers, _gains, _positions, _period,
)  # fmt: skip
