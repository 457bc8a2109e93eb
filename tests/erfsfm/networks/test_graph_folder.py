"""Graphs are kept on disk by what they are made from."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from erfsfm.networks import graph_folder
from erfsfm.networks.graph_folder import folder, kept_graph
from erfsfm.networks.onnx_graph import OnnxGraph

NO_CODE = shutil.ignore_patterns("weights", "__pycache__")
IMAGE = torch.ones(1, 3, 4, 4)


class Times(nn.Module):
    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = factor

    def forward(self, image: Tensor) -> Tensor:
        return self.factor * image


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))


def output(factor: float, identity: str, image: Tensor = IMAGE) -> float:
    return float(OnnxGraph(Times(factor).eval(), 1, identity)(image).max())


@torch.inference_mode()
def test_the_graph_of_a_network_is_read_again_and_no_other(tmp_path: Path) -> None:
    assert output(2.0, "two") == 2.0
    assert folder() == tmp_path / "erfsfm" and len(list(folder().iterdir())) == 1
    assert output(3.0, "two") == 2.0, "the graph was made again"
    assert output(3.0, "three") == 3.0
    assert output(3.0, "two", torch.ones(1, 3, 8, 8)) == 3.0, "the graph is of images of another size"
    assert output(5.0, "") == 5.0


def test_a_damaged_graph_is_made_again() -> None:
    assert kept_graph("one", lambda: b"graph") == b"graph"
    (file,) = folder().iterdir()
    for content in (b"", file.read_bytes()[:-1], file.read_bytes().replace(b"graph", b"graff")):
        file.write_bytes(content)
        assert kept_graph("one", lambda: b"graph") == b"graph"
    assert kept_graph("one", lambda: b"another") == b"graph"


@pytest.mark.parametrize("changed", ["networks/blocks.py", "geometry/alignment.py", "inference.py"])
def test_a_graph_of_older_code_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str) -> None:
    package = shutil.copytree(Path(graph_folder.__file__).parents[1], tmp_path / "code", ignore=NO_CODE)
    monkeypatch.setattr(graph_folder, "__file__", str(package / "networks" / "graph_folder.py"))
    assert kept_graph("one", lambda: b"old") == b"old" == kept_graph("one", lambda: b"new")
    (package / changed).write_text("# changed")
    assert kept_graph("one", lambda: b"new") == b"new"


def test_the_oldest_graphs_are_deleted() -> None:
    for number in range(20):
        kept_graph(str(number), lambda: b"graph")
    assert len(list(folder().iterdir())) == 16


def test_a_folder_that_cannot_be_written_costs_time_alone(tmp_path: Path) -> None:
    (tmp_path / "erfsfm").write_text("a file")
    assert kept_graph("one", lambda: b"first") == b"first"
    assert kept_graph("one", lambda: b"second") == b"second"
