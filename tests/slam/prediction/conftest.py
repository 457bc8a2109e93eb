"""ONNX files of tiny networks, made without training."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest
from onnx import TensorProto, helper

MakeNetwork = Callable[..., Path]


@pytest.fixture
def make_network(tmp_path: Path) -> MakeNetwork:
    """Writes a network that gives the mean of an image's channels, scaled and shifted: ``gain * mean + shift``."""

    def make(
        name: str = "net.onnx",
        shape: tuple[Any, ...] = (1, 3, 16, 32),
        gain: float = 1.0,
        shift: float = 0.0,
        kind: int = TensorProto.FLOAT,
        outputs: int = 1,
        operator: str = "ReduceMean",
    ) -> Path:
        domain = "" if operator == "ReduceMean" else "strange.operators"
        arguments = {"axes": [shape.index(3) if 3 in shape else 1], "keepdims": 1} if not domain else {}
        nodes = [helper.make_node(operator, ["image"], ["mean"], domain=domain, **arguments)]
        constants = []
        for word, number in (("gain", gain), ("shift", shift)):
            constants.append(helper.make_tensor(word, kind, [1], [number]))
        nodes.append(helper.make_node("Mul", ["mean", "gain"], ["scaled"]))
        nodes.append(helper.make_node("Add", ["scaled", "shift"], ["depth"]))
        results = [helper.make_tensor_value_info("depth", kind, None)]
        if outputs == 2:
            results.append(helper.make_tensor_value_info("scaled", kind, None))
        graph = helper.make_graph(
            nodes, "tiny", [helper.make_tensor_value_info("image", kind, list(shape))], results, constants
        )
        imports = [helper.make_opsetid("", 17)] + ([helper.make_opsetid(domain, 1)] if domain else [])
        path = tmp_path / name
        onnx.save(helper.make_model(graph, opset_imports=imports, ir_version=8), path)
        return path

    return make
