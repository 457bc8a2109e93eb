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
from slam.prediction.onnx_depth import OnnxDepth
from slam.runtime.errors import SlamError

MakeNetwork = Callable[..., Path]
PLAIN: dict[str, Any] = {"kind": "depth", "mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}


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


def test_weights_in_other_files_are_refused(make_network: MakeNetwork, tmp_path: Path) -> None:
    model = onnx.load(make_network())
    for tensor in model.graph.initializer:
        tensor.raw_data = np.float32(1).tobytes()
        tensor.ClearField("float_data")
    onnx.save(model, tmp_path / "split.onnx", save_as_external_data=True, location="weights.bin", size_threshold=0)
    with pytest.raises(SlamError, match="weights in other files, which are not read: save it as one file"):
        opened(tmp_path / "split.onnx")
