"""Depth by the network of an ONNX file: its input, its output, and files that are refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from slam.config.sections import DepthConfig
from slam.frames import Frame, Image
from slam.prediction import onnx_depth
from slam.prediction.onnx_depth import OnnxDepth
from slam.runtime.errors import SlamError

MakeNetwork = Callable[..., Path]
PLAIN: dict[str, Any] = {"kind": "depth", "mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}


def opened(path: Path, **settings: Any) -> OnnxDepth:
    return OnnxDepth(DepthConfig(source=f"onnx:{path}", **(PLAIN | settings)))


def image(value: int = 51, height: int = 16, width: int = 32) -> Image:
    return np.full((height, width, 3), value, np.uint8)


@pytest.mark.parametrize(
    "shape", [(1, 3, 16, 32), ("batch", 3, 16, 32), (1, 16, 32, 3), (3, 16, 32), (16, 32, 3), (1, 3, 16, "width")]
)
def test_images_of_every_layout_are_taken(make_network: MakeNetwork, shape: tuple[Any, ...]) -> None:
    source = opened(make_network(shape=shape), width=32 if shape[-1] == "width" else 0)
    np.testing.assert_allclose(source.infer(image(51)), np.full((16, 32), 0.2), rtol=1e-6)
    np.testing.assert_allclose(source.disparity(Frame(0, 0.0, image(51))), np.full((16, 32), 5.0), rtol=1e-6)


def test_mean_and_deviation_of_each_channel(make_network: MakeNetwork) -> None:
    source = opened(make_network(), mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
    pixel = np.array([100, 150, 200], np.uint8)
    wanted = ((pixel / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]).mean()
    np.testing.assert_allclose(source.infer(np.tile(pixel, (16, 32, 1))), wanted, rtol=1e-5)


def test_half_precision_is_taken(make_network: MakeNetwork) -> None:
    source = opened(make_network(kind=10))
    np.testing.assert_allclose(source.infer(image(51)), 0.2, rtol=1e-3)


def test_images_are_resized_to_the_network(make_network: MakeNetwork) -> None:
    assert opened(make_network()).infer(image(51, 64, 100)).shape == (16, 32)
    dynamic = make_network("dynamic.onnx", (1, 3, "height", "width"))
    assert opened(dynamic, height=28, width=42).infer(image(51, 64, 100)).shape == (28, 42)


def test_depth_and_disparity_are_told_apart_and_unknown_pixels_stay_unknown(make_network: MakeNetwork) -> None:
    frame = Frame(0, 0.0, np.concatenate([image(0), image(255)], axis=1)[:, ::2].copy())
    path = make_network(gain=2.0)
    far, near = opened(path, kind="disparity").disparity(frame)[0, [0, -1]]
    assert np.isnan(far) and near == pytest.approx(2.0)
    far, near = opened(path).disparity(frame)[0, [0, -1]]
    assert np.isnan(far) and near == pytest.approx(0.5)
    for shift in (np.nan, np.inf, -3.0):
        assert np.isnan(opened(make_network("bad.onnx", shift=shift)).disparity(frame)).all()


@pytest.mark.parametrize(
    ("made", "settings", "parts"),
    [
        ({"shape": (1, 1, 16, 32)}, {}, ["one input", "RGB image", "[1, 1, 16, 32]"]),
        ({"shape": (4, 3, 16, 32)}, {}, ["one input", "[4, 3, 16, 32]"]),
        ({"kind": 11}, {}, ["one input", "tensor(double)"]),
        ({"shape": (1, 3, "h", "w")}, {}, ["any size", "depth.height and depth.width"]),
        ({}, {"height": 32}, ["height 16, not 32", "leave depth.height out"]),
        ({"outputs": 2}, {}, ["2 outputs", "depth.output_name", "depth, scaled"]),
        ({}, {"output_name": "uncertainty"}, ["no output uncertainty", "one of depth"]),
        ({}, {"kind": "auto", "mean": None}, ["depth.kind=", "depth.mean=[0.485,0.456,0.406]"]),
        ({"operator": "Mystery"}, {}, ["cannot be run by onnxruntime", "own operators alone"]),
    ],
)
def test_what_does_not_fit_is_one_line(
    make_network: MakeNetwork, made: dict[str, Any], settings: dict[str, Any], parts: list[str]
) -> None:
    with pytest.raises(SlamError) as caught:
        opened(make_network(**made), **settings)
    assert "\n" not in str(caught.value) and all(part in str(caught.value) for part in ["net.onnx", *parts])


def test_a_network_that_fails_or_gives_no_map_is_found_at_once(make_network: MakeNetwork) -> None:
    path = make_network(shape=(1, 3, "height", "width"))
    model = onnx.load(path)
    shape = onnx.helper.make_tensor("shape", onnx.TensorProto.INT64, [3], [2, 14, 14])
    model.graph.initializer.append(shape)
    model.graph.node[-1].output[0] = "whole"
    model.graph.node.append(onnx.helper.make_node("Reshape", ["whole", "shape"], ["depth"]))
    onnx.save(model, path)
    with pytest.raises(SlamError, match=r"net\.onnx fails on an image of 32x16: .*"):
        opened(path, height=16, width=32)
    with pytest.raises(
        SlamError,
        match=r"must be floats of one map \(1, 1, H, W\) of at most 67,108,864 pixels; got float32 \(2, 14, 14\)",
    ):
        opened(path, height=14, width=28)


def test_a_network_without_an_end_is_ended(make_network: MakeNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make_network()
    model = onnx.load_model(path)
    yes = onnx.helper.make_tensor("yes", onnx.TensorProto.BOOL, [], [True])
    value = [onnx.helper.make_tensor_value_info(name, 1, None) for name in ("state", "next")]
    flags = [onnx.helper.make_tensor_value_info(name, 9, []) for name in ("before", "after")]
    count = onnx.helper.make_tensor_value_info("count", 7, [])
    nodes = [
        onnx.helper.make_node("Identity", ["before"], ["after"]),
        onnx.helper.make_node("Sqrt", ["state"], ["next"]),
    ]
    body = onnx.helper.make_graph(nodes, "body", [count, flags[0], value[0]], [flags[1], value[1]])
    model.graph.node[-1].output[0] = "once"
    model.graph.node.append(onnx.helper.make_node("Loop", ["", "yes", "once"], ["depth"], body=body))
    model.graph.initializer.append(yes)
    onnx.save(model, path)
    monkeypatch.setattr(onnx_depth, "_MOST_S", 0.5)
    with pytest.raises(SlamError, match=r"has no answer to an image of 32x16 after 0\.5 s"):
        opened(path)


def test_an_output_can_be_chosen(make_network: MakeNetwork) -> None:
    source = opened(make_network(outputs=2, gain=2.0, shift=1.0), output_name="scaled")
    np.testing.assert_allclose(source.infer(image(51)), 0.4, rtol=1e-6)


def test_weights_in_other_files_are_refused(make_network: MakeNetwork, tmp_path: Path) -> None:
    model = onnx.load(make_network())
    for tensor in model.graph.initializer:
        tensor.raw_data = np.float32(1).tobytes()
        tensor.ClearField("float_data")
    onnx.save(model, tmp_path / "split.onnx", save_as_external_data=True, location="weights.bin", size_threshold=0)
    with pytest.raises(SlamError, match="weights in other files, which are not read: save it as one file"):
        opened(tmp_path / "split.onnx")
