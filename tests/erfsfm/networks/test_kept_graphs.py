"""Graphs are kept on disk by what they are made from."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from torch import Tensor, nn

from erfsfm.networks import onnx_graph
from erfsfm.networks.onnx_graph import Array, OnnxGraph, folder, keep, kept

NO_CODE = shutil.ignore_patterns("weights", "__pycache__")
IMAGE = np.ones((1, 3, 4, 4), np.float32)


class Times(nn.Module):
    def __init__(self, factor: float) -> None:
        super().__init__()
        self.factor = factor

    def forward(self, image: Tensor) -> Tensor:
        return self.factor * image


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))


def output(factor: float, identity: str, image: Array = IMAGE) -> float:
    return float(OnnxGraph(lambda: Times(factor).eval(), 1, identity)(image).max())


def kept_graph(made_from: str, made: bytes) -> bytes:
    graph = kept(made_from)
    if graph is None:
        keep(made_from, made)
    return made if graph is None else graph


def test_the_graph_of_a_network_is_read_again_and_no_other(tmp_path: Path) -> None:
    assert output(2.0, "two") == 2.0
    assert folder() == tmp_path / "erfsfm" and len(list(folder().iterdir())) == 1
    assert output(3.0, "two") == 2.0, "the graph was made again"
    assert output(3.0, "three") == 3.0
    assert output(3.0, "two", np.ones((1, 3, 8, 8), np.float32)) == 3.0, "the graph is of images of another size"
    assert output(5.0, "") == 5.0


def test_a_damaged_graph_is_made_again() -> None:
    assert kept_graph("one", b"graph") == b"graph"
    (file,) = folder().iterdir()
    for content in (b"", file.read_bytes()[:-1], file.read_bytes().replace(b"graph", b"graff")):
        file.write_bytes(content)
        assert kept_graph("one", b"graph") == b"graph"
    assert kept_graph("one", b"another") == b"graph"


@pytest.mark.parametrize("changed", ["networks/blocks.py", "geometry/alignment.py"])
def test_a_graph_of_older_code_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str) -> None:
    package = shutil.copytree(Path(onnx_graph.__file__).parents[1], tmp_path / "code", ignore=NO_CODE)
    monkeypatch.setattr(onnx_graph, "__file__", str(package / "networks" / "onnx_graph.py"))
    assert kept_graph("one", b"old") == b"old" == kept_graph("one", b"new")
    (package / changed).write_text("# changed")
    assert kept_graph("one", b"new") == b"new"
