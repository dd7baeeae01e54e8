"""Benchmark: a step of a contract policy against the bare onnxruntime call inside it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from bench_table import ROOT, Row, interleaved
from bench_walk import G1, adopted

from sim2real.policy import Policy, load_policy

FACTOR = 1.3  # how much slower than the bare call we may be


def rows() -> Iterator[Row]:
    """Every policy shipped, and an adopted one."""
    for path in [*sorted(ROOT.glob("policies/*/*.onnx")), adopted(G1)]:
        yield overhead(load_policy(path))


def overhead(policy: Policy) -> Row:
    """``step``, with its signals copied in and its carries fed back, against the faster of onnxruntime's two ways."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.enable_mem_reuse = False  # as sim2real/policy.py has it
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(policy.path.read_bytes(), options, providers=["CPUExecutionProvider"])
    feeds = {name: np.zeros((1, *shape), np.float32) for name, shape in policy.contract.inputs.items()}
    if "orientation_base_in_world" in feeds:
        feeds["orientation_base_in_world"][0, 0] = 1.0
    results = {name: np.zeros((1, *shape), np.float32) for name, shape in policy.contract.outputs.items()}
    binding = session.io_binding()
    for name, array in feeds.items():
        binding.bind_ortvalue_input(name, onnxruntime.OrtValue.ortvalue_from_numpy(array))
    for name, array in results.items():
        binding.bind_ortvalue_output(name, onnxruntime.OrtValue.ortvalue_from_numpy(array))
    signals = {name: array[0] for name, array in feeds.items()}
    took = interleaved(
        {
            "step": lambda: policy.step(signals),
            "run": lambda: session.run(None, feeds),
            "bound": lambda: session.run_with_iobinding(binding),
        }
    )
    bare = min(("run", "bound"), key=took.__getitem__)
    ratio = took["step"] / took[bare]
    return Row(
        f"policy step: {policy.contract.name}",
        f"{took['step'] * 1e6:.1f} us",
        f"{took[bare] * 1e6:.1f} us bare onnxruntime ({bare})",
        f"{ratio:.2f}x",
        f"< {FACTOR:g}x",
        ratio < FACTOR,
        {"seconds": took},
    )
