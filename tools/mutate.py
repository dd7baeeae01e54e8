"""Mutation test of the safety gate: one small change at a time, and some test must notice.

``python tools/mutate.py [FILTER]`` changes sim2real/safety/*.py in memory: a forked process gets the changed code from
its import system and runs the gate's tests until the first failure. Prints every survivor and exits 1 if there is one.
FILTER: only mutants whose line of output contains it. There is no list of exceptions: code that cannot be tested is
to be written otherwise.
"""

from __future__ import annotations

import gc
import importlib.machinery
import os
import signal
import sys
import time
from pathlib import Path
from types import CodeType

from mutants import mutants

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
FORK = ("hypothesis.strategies", "numpy", "pytest", "sim2real.config")  # imported once, before the forks
TESTS = ("test_safety_md.py", "test_gate.py", "test_boundaries.py", "test_sequences.py", "test_properties.py")
HANG = 120  # s; a mutant that takes longer has been noticed


def born(module: str = "", code: CodeType | None = None) -> int:
    """Fork a process that is the mutant, is tested, and ends with 0 if nobody noticed. Returns its id."""
    if pid := os.fork():
        return pid
    import pytest

    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    signal.alarm(HANG)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    loader, original = importlib.machinery.SourceFileLoader, importlib.machinery.SourceFileLoader.get_code
    loader.get_code = lambda self, name: code if name == module else original(self, name)
    tests = [str(ROOT / "tests/sim2real/safety" / name) for name in TESTS]
    os._exit(pytest.main(["-xq", "-pno:cacheprovider", "--joints=2", f"--rootdir={ROOT}", *tests]))


def main(wanted: str = "") -> int:
    begin = time.monotonic()
    for name in FORK:
        importlib.import_module(name)
    gc.freeze()
    if os.waitpid(born(), 0)[1]:
        sys.exit("the tests of the gate fail on the gate itself: run pytest tests/sim2real/safety, then come back")
    files = sorted((ROOT / "sim2real/safety").glob("*.py"))
    todo = [(text, f"sim2real.safety.{f.stem}", code) for f in files for text, code in mutants(f) if wanted in text]
    running, survivors = {}, 0
    queue = iter(todo)
    while True:
        while len(running) < (os.cpu_count() or 1) and (mutant := next(queue, None)):
            running[born(*mutant[1:])] = mutant[0]
        if not running:
            break
        pid, status = os.wait()
        text = running.pop(pid)
        if status == 0:
            survivors += 1
            print(f"survived  {text}", flush=True)
    print(f"{len(todo)} mutants, {survivors} survived, {time.monotonic() - begin:.0f} s")
    return bool(survivors)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
