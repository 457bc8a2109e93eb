"""Depth by the network of an ONNX file: its input, its output, and files that are refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from slam.config.sections import DepthConfig
from slam.frames import Frame, Image
from slam.prediction.depth_source import OnnxDepth
from slam.runtime.errors import SlamError

MakeNetwork = Callable[..., Path]
PLAIN: dict[str, Any] = {"kind": "depth", "mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}


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


def opened(path: Path, **settings: Any) -> OnnxDepth:
    return OnnxDepth(DepthConfig(source=f"onnx:{path}", **(PLAIN | settings)))


def image(value: int = 51, height: int = 16, width: int = 32) -> Image:
    return np.full((height, width, 3), value, np.uint8)


def test_mean_and_deviation_of_each_channel(make_network: MakeNetwork) -> None:
    source = opened(make_network(), mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
    pixel = np.array([100, 150, 200], np.uint8)
    wanted = ((pixel / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]).mean()
    np.testing.assert_allclose(source.infer(np.tile(pixel, (16, 32, 1))), wanted, rtol=1e-5)


def test_depth_and_disparity_are_told_apart_and_unknown_pixels_stay_unknown(make_network: MakeNetwork) -> None:
    frame = Frame(0, 0.0, np.concatenate([image(0), image(255)], axis=1)[:, ::2].copy())
    path = make_network(gain=2.0)
    far, near = opened(path, kind="disparity").disparity(frame)[0, [0, -1]]
    assert np.isnan(far) and near == pytest.approx(2.0)
    far, near = opened(path).disparity(frame)[0, [0, -1]]
    assert np.isnan(far) and near == pytest.approx(0.5)
    for shift in (np.nan, np.inf, -3.0):
        assert np.isnan(opened(make_network("bad.onnx", shift=shift)).disparity(frame)).all()


def test_a_network_that_fails_or_gives_no_map_is_found_at_once(make_network: MakeNetwork) -> None:
    path = make_network(shape=(1, 3, "height", "width"))
    model = onnx.load(path)
    shape = helper.make_tensor("shape", TensorProto.INT64, [3], [2, 14, 14])
    model.graph.initializer.append(shape)
    model.graph.node[-1].output[0] = "whole"
    model.graph.node.append(helper.make_node("Reshape", ["whole", "shape"], ["depth"]))
    onnx.save(model, path)
    with pytest.raises(SlamError, match=r"net\.onnx fails on an image of 32x16: .*"):
        opened(path, size=(16, 32))
    with pytest.raises(
        SlamError,
        match=r"must be floats of one map \(1, 1, H, W\) of at most 67,108,864 pixels; got float32 \(2, 14, 14\)",
    ):
        opened(path, size=(14, 28))


def test_the_size_is_that_of_the_file_or_is_set(make_network: MakeNetwork) -> None:
    with pytest.raises(SlamError, match=r"any size: set depth\.size=\[HEIGHT,WIDTH\]"):
        opened(make_network(shape=(1, 3, "height", "width")))
    assert opened(make_network(), size=(16, 32)).disparity(Frame(0, 0.0, image())).shape == (16, 32)
    with pytest.raises(SlamError, match=r"height and width \[16, 32\], not \[14, 28\]: leave depth\.size out"):
        opened(make_network(), size=(14, 28))


def test_weights_in_other_files_are_refused(make_network: MakeNetwork, tmp_path: Path) -> None:
    model = onnx.load(make_network())
    for tensor in model.graph.initializer:
        tensor.raw_data = np.float32(1).tobytes()
        tensor.ClearField("float_data")
    onnx.save(model, tmp_path / "split.onnx", save_as_external_data=True, location="weights.bin", size_threshold=0)
    with pytest.raises(SlamError, match="weights in other files, which are not read: save it as one file"):
        opened(tmp_path / "split.onnx")
