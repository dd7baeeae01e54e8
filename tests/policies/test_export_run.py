"""``sim2real export``: a training run becomes a policy file that computes what was trained."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sim2real import cli
from sim2real.config import load_robot
from sim2real.policy import load_policy

torch = pytest.importorskip("torch", reason="export needs torch: pip install 'sim2real[train]'")
pytest.importorskip("rsl_rl", reason="training needs rsl_rl: pip install 'sim2real[train]'")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of no iterations: its networks are fresh, so the robots follow their references."""
    from policies.basics import Basics
    from policies.train import Training

    folder = tmp_path_factory.mktemp("run")
    training = Training(Basics(envs=2), folder)
    (folder / "config.json").write_text(json.dumps(training._provenance()))
    (folder / "curve.jsonl").write_text("")
    training._save("best.pt")
    return folder


@pytest.mark.slow
def test_export(run, tmp_path, monkeypatch, capsys):
    from policies import release
    from policies.train import load_config, load_graph

    signals, values = release.training_signals, release.healthy_values
    monkeypatch.setattr(release, "training_signals", lambda graph: signals(graph, ticks=20))
    monkeypatch.setattr(release, "healthy_values", lambda graph: values(graph, episodes=2, ticks=110))
    file = tmp_path / "basics.onnx"
    assert cli.main(["export", str(run), "-o", str(file)]) == 0
    assert "golden error" in capsys.readouterr().out
    robot = load_robot("g1")
    policy, graph = load_policy(file, robot), load_graph(run)
    contract = policy.contract
    assert contract.skill_labels == graph.labels
    for golden in contract.golden:
        assert len({tuple(row) for row in golden.inputs["skill"]}) > 1, "skills change within a golden sequence"
    assert set(contract.envelope) == {n for n in contract.inputs if not n.startswith("carry_")}
    follow(policy, load_config(run), graph)


def follow(policy, config, graph):
    """The file sees and asks for what the training environment sees and asks for, tick by tick, skills changing."""
    from policies.env import Env

    script = np.repeat([[0, 3, 1, 2]], 10, axis=1)
    env = Env(config, 5, script, level=None)
    with torch.no_grad():
        for t in range(script.shape[1]):
            outputs = policy.step({n: v[0].numpy() for n, v in env.signals.items()})
            np.testing.assert_allclose(outputs["observation"], env.observation[0], atol=1e-5, err_msg=f"tick {t}")
            env.step(graph.actor(env.observation))
            np.testing.assert_allclose(outputs["joint_pos_target"], env.target[0], atol=1e-5, err_msg=f"tick {t}")


def test_nothing_to_export(tmp_path, capsys):
    assert cli.main(["export", str(tmp_path), "-o", str(tmp_path / "x.onnx")]) == 2
    assert "got no best.pt with a config.json beside it" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
