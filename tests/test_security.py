"""What the source may not do at all: run what a file says, open the network to everyone, go through a shell."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import PurePosixPath

import pytest
from source import PACKAGES, calls, complaints, complaints_about, imports

MODULES = {"pickle", "cPickle", "joblib", "dill", "cloudpickle", "marshal", "shelve"}  # loading one runs what it says
CALLS = {
    "eval": "runs text",
    "exec": "runs text",
    "__import__": "write import_module and a table",
    "yaml.load": "use yaml.safe_load",
    "yaml.unsafe_load": "use yaml.safe_load",
    "yaml.full_load": "use yaml.safe_load",
    "os.system": "use subprocess.run with a list",
    "os.popen": "use subprocess.run with a list",
    "subprocess.getoutput": "use subprocess.run with a list",
    "tempfile.mktemp": "another program may take the name first; use mkstemp or a TemporaryDirectory",
    "random.seed": "pass a numpy Generator",
    "np.random.seed": "pass a numpy Generator",
}
KEYWORDS = {("shell", True), ("allow_pickle", True), ("weights_only", False), ("check_hostname", False)}
WILDCARDS = {"0.0.0.0", "::"}
UNPICKLERS = {"torch.load": "weights_only=True"}  # safe only with this keyword
TORCHSCRIPT_IN = "policies/adopt/*.py"  # a foreign policy may come as nothing else


def dangerous(path: str, tree: ast.Module) -> Iterator[tuple[int, str]]:
    for line, module in imports(tree):
        if module.partition(".")[0] in MODULES:
            yield line, f"imports {module}: loading one runs what the file says"
    for call, name in calls(tree):
        keywords = {k.arg: ast.unparse(k.value) for k in call.keywords}
        if name in CALLS:
            yield call.lineno, f"{name}: {CALLS[name]}"
        for keyword, value in KEYWORDS:
            if keywords.get(keyword) == str(value):
                yield call.lineno, f"{name}({keyword}={value})"
        if name in UNPICKLERS and keywords.get("weights_only") != "True":
            yield call.lineno, f"{name} without {UNPICKLERS[name]}"
        if name == "torch.jit.load" and not PurePosixPath(path).match(TORCHSCRIPT_IN):
            yield call.lineno, f"{name}: only {TORCHSCRIPT_IN} may"
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and node.value in WILDCARDS:
            yield node.lineno, f"listens on every interface: {node.value!r}; use 127.0.0.1"
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(".bind") and "('', " in ast.unparse(node):
            yield node.lineno, "listens on every interface: ''; use 127.0.0.1"


def test_nothing_dangerous():
    found = complaints(dangerous, *PACKAGES, "tools")
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "def f():\n    from joblib import load",
        "eval(text)",
        "exec(text)",
        "yaml.load(text, Loader=yaml.SafeLoader)",
        "np.load(path, allow_pickle=True)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "torch.jit.load(path)",
        "subprocess.run(line, shell=True)",
        "os.system(line)",
        "serve(host='0.0.0.0')",
        "s.bind(('', 80))",
        "np.random.seed(0)",
    ],
)
def test_the_check_can_fail(text):
    assert complaints_about(dangerous, "sim2real/pilot.py", text)


@pytest.mark.parametrize("text", ["torch.load(path, weights_only=True)", "yaml.safe_load(text)", "s.bind(str(path))"])
def test_the_check_can_pass(text):
    assert not complaints_about(dangerous, "sim2real/pilot.py", text)
