"""Training: a resumed run is the run that never stopped, and it leaves what it should beside its checkpoints."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from policies.basics import Basics
from policies.train import Training, load_config, load_graph
from policies.training import learner_device
from sim2real.types import Sim2realError

SHIPPED = Path(__file__).resolve().parents[2] / "policies" / "g1" / "basics.pt"
TINY = Basics(envs=8, horizon=4, hidden=(16,), save_every=2, evaluate_every=1000, samples=8 * 4 * 4,
              ppo={**Basics().ppo, "num_mini_batches": 2, "num_learning_epochs": 1})  # fmt: skip


def parameters(training: Training) -> dict[str, torch.Tensor]:
    return {
        **training.ppo.actor.state_dict(),
        **{f"critic.{k}": v for k, v in training.ppo.critic.state_dict().items()},
    }


def test_a_resumed_run_continues_exactly(tmp_path):
    whole = Training(TINY, tmp_path / "whole")
    whole.run()
    half = Training(dataclasses.replace(TINY, samples=8 * 4 * 2), tmp_path / "split")
    half.config = TINY  # the same schedule, interrupted after two iterations
    for _ in range(2):
        half.step()
    half.folder.mkdir()
    half._save("last.pt")
    (half.folder / "curve.jsonl").write_text('{"iteration": 1}\n{"iteration": 2}\n{"iteration": 3}\n')
    rest = Training(TINY, tmp_path / "split")
    assert rest.resume() and rest.iteration == 2
    rest.run()
    assert rest.iteration == whole.iteration == 4
    for name, value in parameters(whole).items():
        assert torch.equal(value, parameters(rest)[name]), name
    assert whole.env.state_dict() == rest.env.state_dict()
    curve = [json.loads(line)["iteration"] for line in (tmp_path / "split" / "curve.jsonl").read_text().splitlines()]
    assert curve == [1, 2, 3, 4]  # the 3 that was never checkpointed is gone


def test_a_run_leaves_its_config_and_curve(tmp_path):
    rows = []
    Training(TINY, tmp_path).run(rows.append)
    document = json.loads((tmp_path / "config.json").read_text())
    assert document["config"]["seed"] == TINY.seed and document["tools"]["mujoco"]
    assert load_config(tmp_path) == TINY
    curve = [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()]
    assert curve == rows and [r["samples"] for r in curve] == [32, 64, 96, 128]
    graph = load_graph(tmp_path, "last.pt")
    assert graph.actor(torch.zeros(1, *graph.outputs()["observation"])).shape == (1, 15)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU")
def test_a_learner_on_a_gpu_leaves_checkpoints_that_a_cpu_reads_and_goes_on_from(tmp_path):
    there = Training(dataclasses.replace(TINY, device="cuda", evaluate_every=1), tmp_path)
    there.run()
    assert {p.device.type for p in parameters(there).values()} == {"cuda"}
    graph = load_graph(tmp_path)
    assert {p.device.type for p in graph.actor.parameters()} == {"cpu"}
    here = Training(TINY, tmp_path)
    assert here.resume()
    for name, value in parameters(there).items():
        torch.testing.assert_close(parameters(here)[name], value.cpu())


def test_processes_under_torchrun_are_one_run(tmp_path):
    run = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [Path(sys.executable).with_name("sim2real"), "train", "g1-basics", "--envs", "4", "--samples", "200"]
    alone = {k: v for k, v in os.environ.items() if k not in ("RANK", "WORLD_SIZE", "LOCAL_RANK")}
    done = subprocess.run(
        [*run, *command, "--folder", tmp_path], env={**alone, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "config.json").read_text())["world"] == 2
    curve = [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()]
    horizon = Basics().horizon
    assert [row["samples"] for row in curve] == [2 * 4 * horizon * k for k in range(1, len(curve) + 1)]
    assert curve[-1]["samples"] >= 200 and (tmp_path / "last.pt").is_file()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(Sim2realError, match="device: got 'cuda', but torch .* finds no GPU; expected 'cpu'"):
        Training(dataclasses.replace(TINY, device="cuda"), tmp_path / "run")
    assert not (tmp_path / "run").exists()
    with pytest.raises(Sim2realError, match="device: got 'tpu', but no such device"):
        learner_device("tpu")


def test_networks_of_a_learner_elsewhere_are_copied_beside_the_physics(tmp_path):
    training = Training(TINY, tmp_path)
    network = training.ppo.actor.mlp
    assert training.beside_physics(network) is network
    training.device = torch.device("cuda")
    copied = training.beside_physics(network)
    assert copied is not network and {p.device.type for p in copied.parameters()} == {"cpu"}


def test_no_checkpoint_is_refused_with_the_next_step(tmp_path):
    with pytest.raises(Sim2realError, match="sim2real train"):
        load_graph(tmp_path)


def test_a_run_may_start_from_the_shipped_checkpoint_and_refuses_another_file(tmp_path):
    training = Training(dataclasses.replace(Basics(), envs=2), tmp_path / "run")
    (tmp_path / "not.pt").write_bytes(b"nothing of the kind")
    for wrong in ("not.pt", "absent.pt"):
        with pytest.raises(Sim2realError, match="expected a checkpoint"):
            training.start_from(tmp_path / wrong)
    before = {name: value.clone() for name, value in parameters(training).items()}
    training.start_from(SHIPPED)
    assert any(not torch.equal(before[name], value) for name, value in parameters(training).items())
    assert training.samples == 0
