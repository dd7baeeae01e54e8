"""What several tests of ball skills ask for."""

from __future__ import annotations

import pytest
import torch

from policies.skillmimic.release import export_graph


@pytest.fixture(scope="module")
def one_thread():
    """Two threads of torch spin against each other on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def file(graph, tmp_path_factory):
    """The policy file of the module's own ``graph``."""
    path = tmp_path_factory.mktemp("policy") / "ball.onnx"
    export_graph(graph, path)
    return path
