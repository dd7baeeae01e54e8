"""Policy files that must not run. Each refusal is one message, by name, with exit code 2 and nothing else printed."""

from __future__ import annotations

import json

import numpy as np
import onnx
import pytest
import tiny_policy
from onnx import TensorProto, helper
from tiny_policy import TEXT

from sim2real import cli
from sim2real.config import load_robot
from sim2real.contract import METADATA_KEY
from sim2real.graph import MAX_BYTES, SEAL_KEY, metadata, seal
from sim2real.policy import PolicyError, load_policy


@pytest.fixture(scope="module")
def g1():
    return load_robot("g1")


@pytest.fixture
def refused(tmp_path, capfd):
    """Check a file by the command line as a user would; returns its one message."""

    def check(data: bytes) -> str:
        path = tmp_path / "policy.onnx"
        path.write_bytes(data)
        assert cli.main(["check", str(path), "--robot", "g1"]) == 2
        out, err = capfd.readouterr()
        assert out == "" and err.startswith("error: ") and "Traceback" not in err
        assert err.count(str(path)) == 1, "one message"
        return err

    return check


@pytest.fixture
def good(g1, tmp_path):
    return tiny_policy.write(tmp_path / "good.onnx", tiny_policy.model(g1), tiny_policy.document(g1)).read_bytes()


@pytest.fixture
def sealed(g1, tmp_path):
    """The bytes of a sealed file with another graph, or another contract, or more metadata."""

    def make(graph=None, contract=None, **more):
        graph, contract = graph or tiny_policy.model(g1), contract or tiny_policy.document(g1)
        return tiny_policy.write(tmp_path / "bad.onnx", graph, contract, **more).read_bytes()

    return make


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.9, 0.999])
def test_truncated(refused, good, share):
    message = refused(good[: int(share * len(good))])
    assert any(
        words in message for words in ("do not parse", "got no graph", "no metadata", "got seal")
    ), message  # fmt: skip


def test_every_flipped_bit_is_found(good, tmp_path):
    """One bit in each of 300 places, weights included: 100 of 100 such files load in bare onnxruntime."""
    path = tmp_path / "flipped.onnx"
    rng = np.random.default_rng(3)
    for place in rng.integers(0, len(good), 300):
        data = bytearray(good)
        data[place] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        with pytest.raises(PolicyError):
            load_policy(path, trial=0)


def test_flipped_weight(refused, g1, good):
    place = good.index(tiny_policy.weights(len(g1.joint_names)).tobytes())
    data = bytearray(good)
    data[place] ^= 1  # the last bit of one weight: far below the golden tolerance
    assert "got seal" in refused(bytes(data))


def test_golden_catches_another_graph(refused, sealed, g1):
    """A sealed file whose weights are not those that were recorded."""
    graph = tiny_policy.model(g1)
    graph.graph.initializer[0].CopyFrom(
        onnx.numpy_helper.from_array(1.02 * tiny_policy.weights(len(g1.joint_names)), "weights")
    )
    message = refused(sealed(graph))
    assert "golden[0] step 0, joint_pos_target[" in message and "within 0.0001" in message


def test_not_onnx(refused):
    assert "expected an ONNX file" in refused(b"PK\x03\x04 this is something else")


def test_foreign_onnx(refused, g1):
    message = refused(tiny_policy.model(g1).SerializeToString())
    assert "no metadata 'sim2real' (it has: none)" in message and "sim2real adopt" in message


def test_without_seal(refused, g1):
    graph = tiny_policy.model(g1)
    helper.set_model_props(graph, {METADATA_KEY: json.dumps(tiny_policy.document(g1))})
    assert f"no metadata '{SEAL_KEY}'" in refused(graph.SerializeToString())


def test_too_large(refused, g1):
    assert "got more than 64 MiB, expected at most 64" in refused(bytes(MAX_BYTES + 2**20))


def test_no_such_file(capsys, tmp_path, good):
    assert cli.main(["check", str(tmp_path / "god.onnx")]) == 2
    assert "No such file" in (err := capsys.readouterr().err) and "did you mean 'good.onnx'?" in err


def test_external_data(refused, sealed, g1, tmp_path):
    graph = tiny_policy.model(g1)
    tensor = graph.graph.initializer[0]
    (tmp_path / "weights.bin").write_bytes(tensor.raw_data)
    onnx.external_data_helper.set_external_data(tensor, "weights.bin")
    tensor.ClearField("raw_data")
    message = refused(sealed(graph))
    assert "tensor 'weights': got data in another file" in message and "external_data=False" in message


def test_external_data_inside_a_constant(refused, sealed, g1):
    graph = tiny_policy.model(g1, TEXT.replace("pulled =", "spare = Constant <value = float {{1.0}}> ()\n    pulled ="))
    tensor = graph.graph.node[0].attribute[0].t
    tensor.CopyFrom(onnx.numpy_helper.from_array(np.float32(1.0)))
    onnx.external_data_helper.set_external_data(tensor, "/etc/hostname")
    assert "got data in another file" in refused(sealed(graph))


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("drift = RandomUniformLike (carry_count)", "got operator RandomUniformLike, expected one of Abs,"),
        ("drift = Bernoulli (carry_count)", "got operator Bernoulli"),
        ("drift = com.example.Evil (carry_count)", "got operator com.example.Evil, expected the standard ONNX domain"),
        ("drift = ai.onnx.ml.Normalizer (carry_count)", "got operator ai.onnx.ml.Normalizer"),
    ],
)
def test_operators(refused, sealed, g1, line, words):
    assert words in refused(sealed(tiny_policy.model(g1, TEXT.replace("drift = Mul (carry_count, rate)", line))))


def _body(*outputs: str) -> onnx.GraphProto:
    """A loop body that never says stop."""
    value = lambda name, kind, shape: helper.make_tensor_value_info(name, kind, shape)  # noqa: E731
    return helper.make_graph(
        [helper.make_node("Identity", ["go"], ["again"]), helper.make_node("Identity", ["state"], ["after"])],
        "for_ever",
        [value("i", TensorProto.INT64, []), value("go", TensorProto.BOOL, []), value("state", TensorProto.FLOAT, [1, 1])],
        [value("again", TensorProto.BOOL, []), value("after", TensorProto.FLOAT, [1, 1])],
    )  # fmt: skip


def test_loop_bomb(refused, sealed, g1):
    """Bare onnxruntime loads this and never returns from run()."""
    graph = tiny_policy.model(g1)
    graph.graph.initializer.append(helper.make_tensor("true", TensorProto.BOOL, [], [True]))
    loop = helper.make_node("Loop", ["", "true", "carry_count"], ["drift"], name="bomb", body=_body())
    graph.graph.node[1].CopyFrom(loop)
    assert "node 'bomb': got Loop, which contains a graph" in refused(sealed(graph))


def test_branch(refused, sealed, g1):
    value = helper.make_tensor_value_info("out", TensorProto.FLOAT, [1, 1])
    branch = helper.make_graph([helper.make_node("Identity", ["carry_count"], ["out"])], "branch", [], [value])
    graph = tiny_policy.model(g1)
    graph.graph.initializer.append(helper.make_tensor("true", TensorProto.BOOL, [], [True]))
    graph.graph.node[1].CopyFrom(
        helper.make_node("If", ["true"], ["drift"], name="fork", then_branch=branch, else_branch=branch)
    )
    assert "node 'fork': got If, which contains a graph" in refused(sealed(graph))


def test_local_function(refused, sealed, g1):
    graph = tiny_policy.model(g1)
    node = helper.make_node("Identity", ["x"], ["y"])
    opset = [helper.make_opsetid("", 17)]
    graph.functions.append(helper.make_function("local", "Hidden", ["x"], ["y"], [node], opset))
    assert "got model-local functions (Hidden)" in refused(sealed(graph))


def test_sparse_weights(refused, sealed, g1):
    graph = tiny_policy.model(g1)
    values, places = (
        helper.make_tensor("sparse", TensorProto.FLOAT, [1], [1.0]),
        helper.make_tensor("places", TensorProto.INT64, [1], [0]),
    )
    graph.graph.sparse_initializer.append(helper.make_sparse_tensor(values, places, [4]))
    assert "got sparse weights" in refused(sealed(graph))


def test_graph_that_onnxruntime_refuses(refused, sealed, g1):
    graph = tiny_policy.model(g1, TEXT.replace("Add (pulled, drift)", "Concat <axis = 7> (pulled, drift)"))
    assert "refuses the graph" in refused(sealed(graph))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (TEXT.replace("float[1,{n}] joint_pos,", "float[1,12] joint_pos,"), "input 'joint_pos': got float32[1, 12]"),
        (TEXT.replace("float[1,{n}] joint_pos,", "float[N,{n}] joint_pos,"), "input 'joint_pos': got float32[N, 29]"),
        (TEXT.replace("float[1,{n}] joint_pos,", "float[{n}] joint_pos,"), "input 'joint_pos': got float32[29]"),
        (TEXT.replace("float[1,{n}] joint_pos,", "double[1,{n}] joint_pos,"), "input 'joint_pos': got double[1, 29]"),
        (TEXT.replace("float[1,{n}] joint_pos_target", "float16[1,{n}] joint_pos_target"), "got float16[1, 29]"),
        (TEXT.replace("joint_pos,", "qpos,"), "input 'joint_pos': got it in the metadata only"),
        (TEXT.replace("(float[1,{n}] joint_pos,", "(float[1,1] more, float[1,{n}] joint_pos,"), "input 'more': got it in"),
        (TEXT.replace("joint_pos_target", "target"), "output 'joint_pos_target': got it in the metadata only"),
    ],
)  # fmt: skip
def test_graph_against_metadata(refused, sealed, g1, text, words):
    assert words in refused(sealed(tiny_policy.model(g1, text)))


def test_nan_in_golden(refused, sealed, g1):
    contract = tiny_policy.document(g1)
    contract["golden"][1]["inputs"]["joint_pos"][2][3] = float("nan")
    message = refused(sealed(contract=contract))
    assert "sim2real: golden[1].inputs.joint_pos[2][3]: got nan" in message and "finite number" in message


def test_nan_from_the_graph(refused, sealed, g1):
    graph = tiny_policy.model(g1, TEXT.replace("Mul (carry_count, rate)", "Div (zero, zero)"))
    graph.graph.initializer.append(helper.make_tensor("zero", TensorProto.FLOAT, [1], [0.0]))
    assert "golden[0] step 0, joint_pos_target[0]: got nan" in refused(sealed(graph))


def test_wrong_joint_order_between_readers(refused, sealed, g1):
    swapped = ",".join(reversed(g1.joint_names))
    assert "two readers of this file would move different joints" in refused(sealed(joint_names=swapped))


def test_metadata_is_not_json(refused, sealed):
    assert "Invalid JSON" in refused(sealed(contract="{'name': tiny}"))


def test_control_characters_do_not_reach_the_terminal(refused, sealed, g1):
    contract = tiny_policy.document(g1)
    contract["skills"][0]["description"] = "stands\x1b[2J"
    message = refused(sealed(contract=contract))
    assert "sim2real: skills[0].description: got" in message and "\x1b" not in message


def test_seal_survives_resealing(good):
    """Sealing is idempotent: the same model gives the same bytes."""
    again = onnx.load_from_string(good)
    assert len(metadata(again)[SEAL_KEY]) == 64 and seal(again) == good


def test_deploy_refuses_before_anything_is_opened(good, tmp_path, capfd):
    path = tmp_path / "policy.onnx"
    path.write_bytes(good[:-100])
    command = [
        "deploy",
        "--robot",
        "g1",
        "--policy",
        str(path),
        "--clock",
        "lockstep",
        "--record",
        str(tmp_path / "runs"),
    ]
    assert cli.main(command) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.startswith("error: ") and "truncated or damaged" in err
    assert not (tmp_path / "runs").exists()
