"""Depth from elsewhere beside the pose network: one unit, unknown pixels, frames without depth.

From folders: which file belongs to which frame, and folders that are refused. By the network of an ONNX file: its
input, its output, and files that are refused.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from slam.config.sections import DepthConfig
from slam.frames import DepthMap, Frame, Image, Predictor, SnippetPoses
from slam.prediction.depth_source import (
    DepthFolder,
    Disparity,
    FrameNumbers,
    OnnxDepth,
    SourcedPredictor,
    at_size,
)
from slam.runtime.errors import SlamError

HEIGHT, WIDTH = 40, 96
# disparity of a road below a far wall, in the networks' unit
SCENE = np.tile(np.maximum(np.linspace(-0.4, 1.0, HEIGHT), 0.05)[:, None], (1, WIDTH)).astype(
    np.float32
)
MakeNetwork = Callable[..., Path]
PLAIN: dict[str, Any] = {"kind": "depth", "mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}


def frames(first: int = 0, count: int = 5) -> list[Frame]:
    return [
        Frame(k, 0.1 * k, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        for k in range(first, first + count)
    ]


class Networks:
    """Depth of the scene; every source one unit behind the target."""

    sources = 4

    def depth(self, frame: Frame) -> DepthMap:
        return np.asarray(1 / SCENE, np.float32)

    def snippet(self, frames: list[Frame]) -> SnippetPoses:
        T_source_target = np.tile(np.eye(4), (4, 1, 1))
        T_source_target[:, 2, 3] = 1.0
        indices = [frame.index for frame in frames]
        return SnippetPoses(indices.pop(2), tuple(indices), T_source_target)

    def executor(self) -> Executor:
        return ThreadPoolExecutor(1)


class Source:
    """The scene's disparity times ``gain`` plus ``shift``, known in some frames only."""

    name, sha256 = "npy:depth", "9f"

    def __init__(
        self, gain: float = 1.0, shift: float = 0.0, unknown: tuple[int, ...] = ()
    ) -> None:
        self._gain, self._shift, self._unknown = gain, shift, unknown

    def disparity(self, frame: Frame) -> Disparity:
        disparity = np.asarray(self._gain * SCENE + self._shift, np.float32)
        return np.full_like(disparity, np.nan) if frame.index in self._unknown else disparity


def predictor(source: Source, align: Literal["none", "scale", "affine"] = "none") -> Predictor:
    return SourcedPredictor(Networks(), source, align)


def shifts(snippet: SnippetPoses) -> np.ndarray:
    return snippet.T_source_target[:, 2, 3]


@pytest.mark.parametrize("gain", [0.02, 1.0, 40.0])
def test_poses_get_the_unit_of_a_source_with_one_unit(gain: float) -> None:
    both = predictor(Source(gain))
    np.testing.assert_allclose(both.depth(frames()[0]), 1 / (gain * SCENE), rtol=1e-5)
    snippet = both.snippet(frames())
    np.testing.assert_allclose(shifts(snippet), 1 / gain, rtol=1e-5)
    assert (snippet.target, snippet.sources) == (2, (0, 1, 3, 4))
    np.testing.assert_array_equal(snippet.T_source_target[:, :3, :3], np.tile(np.eye(3), (4, 1, 1)))


@pytest.mark.parametrize(("align", "shift"), [("scale", 0.0), ("affine", 0.3), ("affine", -0.04)])
def test_each_frame_is_aligned_to_the_networks(
    align: Literal["scale", "affine"], shift: float
) -> None:
    both = predictor(Source(7.0, shift), align)
    np.testing.assert_allclose(both.depth(frames()[0]), 1 / SCENE, rtol=1e-3)
    np.testing.assert_array_equal(shifts(both.snippet(frames())), 1.0)


def test_an_alignment_that_would_turn_near_into_far_is_a_scale() -> None:
    upside_down = Source(-1.0, 1.2)
    depth = predictor(upside_down, "affine").depth(frames()[0])
    known = np.isfinite(depth)
    assert known.all() and (depth > 0).all() and depth[0, 0] < depth[-1, 0]


def test_the_unit_of_a_frame_without_depth_is_that_of_the_nearest(
    caplog: pytest.LogCaptureFixture,
) -> None:
    both = predictor(Source(0.5, unknown=(1, 2, 3)))
    with caplog.at_level(logging.WARNING):
        assert np.isnan(both.depth(frames()[2])).all()
        assert np.isfinite(both.depth(frames()[4])).all()
    assert "frame 2 has no known depth in npy:depth" in caplog.text
    np.testing.assert_allclose(shifts(both.snippet(frames())), 2.0, rtol=1e-5)


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (10, 24), (80, 192), (20, 190)])
def test_depth_of_any_size_is_resized_and_unknown_pixels_do_not_spread(
    size: tuple[int, int],
) -> None:
    rows = (np.arange(size[0]) + 0.5) / size[0]
    plane = np.tile((0.1 + 0.9 * rows)[:, None], (1, size[1])).astype(np.float32)
    wanted = np.tile((0.1 + 0.9 * (np.arange(HEIGHT) + 0.5) / HEIGHT)[:, None], (1, WIDTH))
    dense = at_size(plane, HEIGHT, WIDTH)
    np.testing.assert_allclose(dense[4:-4], wanted[4:-4], rtol=0.02)
    plane[:, : size[1] // 2] = np.nan
    half = at_size(plane, HEIGHT, WIDTH)
    np.testing.assert_allclose(
        half[4:-4, WIDTH // 2 + 6 :], wanted[4:-4, WIDTH // 2 + 6 :], rtol=0.02
    )
    assert np.isnan(half[:, : WIDTH // 2 - 6]).all() and half.dtype == np.float32


def frame(index: int) -> Frame:
    return Frame(index, 0.1 * index, np.zeros((HEIGHT, WIDTH, 3), np.uint8))


def folder_of(path: Path, names: list[str]) -> Path:
    """Frame k is k + 1 metres away."""
    path.mkdir(exist_ok=True)
    for k, name in enumerate(names):
        np.save(path / name, np.full((HEIGHT, WIDTH), k + 1.0, np.float32))
    return path


def opened(folder: Path, numbers: FrameNumbers, kind: str = "npy", **settings: Any) -> DepthFolder:
    return DepthFolder(DepthConfig(source=f"{kind}:{folder}", **settings), numbers, WIDTH, HEIGHT)


def metres(source: DepthFolder, index: int) -> float:
    disparity = source.disparity(frame(index))
    assert disparity is not None
    return float(1 / disparity[0, 0])


@pytest.mark.parametrize("first", [0, 1, 100])
def test_files_belong_to_frames_in_the_order_of_their_numbers(tmp_path: Path, first: int) -> None:
    folder = folder_of(tmp_path, [f"depth_{first + k}.npy" for k in range(12)])  # 9 before 10
    source = opened(folder, FrameNumbers(12, 0, 12))
    assert [metres(source, k) for k in range(12)] == pytest.approx(range(1, 13))


def test_a_range_of_frames_takes_its_own_files_of_the_whole_sequence(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, [f"{k:06d}.npy" for k in range(10)])
    assert metres(opened(folder, FrameNumbers(4, 5, 10)), 0) == pytest.approx(6)
    assert metres(opened(folder, FrameNumbers(10, 300, 400)), 0) == pytest.approx(1), (
        "a folder of this range alone"
    )


def test_a_missing_number_is_an_error_only_if_its_frame_is_there(tmp_path: Path) -> None:
    names = [f"{k:06d}.npy" for k in range(8)]
    folder = folder_of(tmp_path, names)
    (folder / names[3]).unlink()
    source = opened(folder, FrameNumbers(8, 0, 8))
    assert metres(source, 4) == pytest.approx(5)
    with pytest.raises(SlamError, match="no depth for frame 3"):
        source.disparity(frame(3))


@pytest.mark.parametrize(("scale", "value"), [(256.0, 10.0), (1000.0, 2.56)])
def test_pictures_of_16_bits_have_a_scale_and_zero_is_unknown(
    tmp_path: Path, scale: float, value: float
) -> None:
    picture = np.full((HEIGHT, WIDTH), 2560, np.uint16)
    picture[0, 0] = 0
    cv2.imwrite(str(tmp_path / "000000.png"), picture)
    disparity = opened(tmp_path, FrameNumbers(1, 0, 1), "png", png_scale=scale).disparity(frame(0))
    assert (
        disparity is not None
        and np.isnan(disparity[0, 0])
        and disparity[5, 5] == pytest.approx(1 / value)
    )


def test_disparity_may_be_given_and_axes_of_length_one_do_not_matter(tmp_path: Path) -> None:
    np.save(tmp_path / "0.npy", np.full((1, HEIGHT, WIDTH, 1), 0.125, np.float16))
    source = DepthFolder(
        DepthConfig(source=f"npy:{tmp_path}", kind="disparity"),
        FrameNumbers(1, 0, 1),
        WIDTH,
        HEIGHT,
    )
    disparity = source.disparity(frame(0))
    assert (
        disparity is not None and disparity.shape == (HEIGHT, WIDTH) and (disparity == 0.125).all()
    )


def test_the_digest_is_of_names_and_content(tmp_path: Path) -> None:
    numbers = FrameNumbers(3, 0, 3)
    first = opened(folder_of(tmp_path / "a", ["0.npy", "1.npy", "2.npy"]), numbers).sha256
    copy = folder_of(tmp_path / "b", ["0.npy", "1.npy", "2.npy"])
    assert opened(copy, numbers).sha256 == first
    np.save(copy / "1.npy", np.full((HEIGHT, WIDTH), 2.5, np.float32))
    assert opened(copy, numbers).sha256 != first


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
        arguments = (
            {"axes": [shape.index(3) if 3 in shape else 1], "keepdims": 1} if not domain else {}
        )
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
            nodes,
            "tiny",
            [helper.make_tensor_value_info("image", kind, list(shape))],
            results,
            constants,
        )
        imports = [helper.make_opsetid("", 17)] + (
            [helper.make_opsetid(domain, 1)] if domain else []
        )
        path = tmp_path / name
        onnx.save(helper.make_model(graph, opset_imports=imports, ir_version=8), path)
        return path

    return make


def opened_onnx(path: Path, **settings: Any) -> OnnxDepth:
    return OnnxDepth(DepthConfig(source=f"onnx:{path}", **(PLAIN | settings)))


def image(value: int = 51, height: int = 16, width: int = 32) -> Image:
    return np.full((height, width, 3), value, np.uint8)


def test_mean_and_deviation_of_each_channel(make_network: MakeNetwork) -> None:
    source = opened_onnx(make_network(), mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
    pixel = np.array([100, 150, 200], np.uint8)
    wanted = ((pixel / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]).mean()
    np.testing.assert_allclose(source.infer(np.tile(pixel, (16, 32, 1))), wanted, rtol=1e-5)


def test_depth_and_disparity_are_told_apart_and_unknown_pixels_stay_unknown(
    make_network: MakeNetwork,
) -> None:
    frame = Frame(0, 0.0, np.concatenate([image(0), image(255)], axis=1)[:, ::2].copy())
    path = make_network(gain=2.0)
    far, near = opened_onnx(path, kind="disparity").disparity(frame)[0, [0, -1]]
    assert np.isnan(far) and near == pytest.approx(2.0)
    far, near = opened_onnx(path).disparity(frame)[0, [0, -1]]
    assert np.isnan(far) and near == pytest.approx(0.5)
    for shift in (np.nan, np.inf, -3.0):
        assert np.isnan(opened_onnx(make_network("bad.onnx", shift=shift)).disparity(frame)).all()


def test_a_network_that_fails_or_gives_no_map_is_found_at_once(make_network: MakeNetwork) -> None:
    path = make_network(shape=(1, 3, "height", "width"))
    model = onnx.load(path)
    shape = helper.make_tensor("shape", TensorProto.INT64, [3], [2, 14, 14])
    model.graph.initializer.append(shape)
    model.graph.node[-1].output[0] = "whole"
    model.graph.node.append(helper.make_node("Reshape", ["whole", "shape"], ["depth"]))
    onnx.save(model, path)
    with pytest.raises(SlamError, match=r"net\.onnx fails on an image of 32x16: .*"):
        opened_onnx(path, size=(16, 32))
    with pytest.raises(
        SlamError,
        match=r"must be floats of one map \(1, 1, H, W\) of at most 67,108,864 pixels; got float32 \(2, 14, 14\)",
    ):
        opened_onnx(path, size=(14, 28))


def test_the_size_is_that_of_the_file_or_is_set(make_network: MakeNetwork) -> None:
    with pytest.raises(SlamError, match=r"any size: set depth\.size=\[HEIGHT,WIDTH\]"):
        opened_onnx(make_network(shape=(1, 3, "height", "width")))
    assert opened_onnx(make_network(), size=(16, 32)).disparity(Frame(0, 0.0, image())).shape == (
        16,
        32,
    )
    with pytest.raises(
        SlamError, match=r"height and width \[16, 32\], not \[14, 28\]: leave depth\.size out"
    ):
        opened_onnx(make_network(), size=(14, 28))


def test_weights_in_other_files_are_refused(make_network: MakeNetwork, tmp_path: Path) -> None:
    model = onnx.load(make_network())
    for tensor in model.graph.initializer:
        tensor.raw_data = np.float32(1).tobytes()
        tensor.ClearField("float_data")
    onnx.save(
        model,
        tmp_path / "split.onnx",
        save_as_external_data=True,
        location="weights.bin",
        size_threshold=0,
    )
    with pytest.raises(
        SlamError, match="weights in other files, which are not read: save it as one file"
    ):
        opened_onnx(tmp_path / "split.onnx")
