"""Read a TorchScript file without trusting it.

Loading TorchScript runs code of the file. So a process of its own does it, limited in time and memory, and hands back
arrays: the weights, and what the module answers to a probe, to prove whatever is rebuilt from them. That bounds
mistakes, not malice: adopt files you would run, or adopt an ONNX file instead, which cannot carry code.
"""

from __future__ import annotations

import io
import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np

from sim2real.policy import PolicyError

SECONDS = 60.0  # importing torch takes most of it
CPU_SECONDS = 60
PROBE = "probe_answer"


def read_torchscript(path: Path, probe: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """(state dict, answers) of the module at ``path``; ``probe`` (steps, n) float32 is fed row by row from a start
    where every ``*_state`` buffer is zero. Raises PolicyError."""
    start = (
        "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from policies.adopt.torchscript import _main; _main()"
    )
    fed = io.BytesIO()
    np.save(fed, probe, allow_pickle=False)
    command = [sys.executable, "-c", start, json.dumps(sys.path), str(path.resolve())]
    try:
        done = subprocess.run(command, input=fed.getvalue(), capture_output=True, timeout=SECONDS, check=False)
    except subprocess.TimeoutExpired:
        raise PolicyError(f"{path}: got no answer within {SECONDS:g} s, expected a TorchScript policy") from None
    said = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or [""]
    if done.returncode and "No module named 'torch'" in said[0]:
        raise PolicyError(
            f"{path}: reading TorchScript needs torch: pip install 'sim2real[train]', or give an ONNX file of the network"
        )
    if done.returncode:
        raise PolicyError(
            f"{path}: got '{said[0][:200]}', expected a TorchScript policy; is the file whole, and from torch.jit.save?"
        )
    arrays = dict(np.load(io.BytesIO(done.stdout), allow_pickle=False))
    return arrays, arrays.pop(PROBE)


def _main() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
    import torch

    torch.set_num_threads(1)
    probe = np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False)
    module = torch.jit.load(sys.argv[2], map_location="cpu").eval()
    with torch.no_grad():
        state = {n: v.numpy().copy() for n, v in module.state_dict().items()}
        for name, value in module.state_dict().items():
            if name.endswith("_state"):
                value.zero_()
        answers = [module(torch.from_numpy(row)[None])[0].numpy() for row in probe]
    result = io.BytesIO()
    np.savez(result, **{PROBE: np.stack(answers)}, **state)
    sys.stdout.buffer.write(result.getvalue())
