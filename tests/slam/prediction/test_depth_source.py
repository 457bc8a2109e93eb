"""Depth from elsewhere beside the pose network: one unit, unknown pixels, frames without depth.

From folders: which file belongs to which frame, and folders that are refused. By the network of an ONNX file: its
input, its output, and files that are refused.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

import slam.commands.cli
from slam import Slam, run_slam
from slam.commands.localisation import localise
from slam.config.sections import DepthConfig, load_config
from slam.frames import DepthMap, Frame, Image, Predictor, SnippetPoses
from slam.prediction.depth_source import (
    DepthFolder,
    Disparity,
    FrameNumbers,
    OnnxDepth,
    SourcedPredictor,
    at_size,
)
from slam.results.folder import RunFolder
from slam.runtime.errors import SlamError
from slam.sequences.catalogue import open_sequence
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import write_kitti_root
from slam.simulation.street import SimulatedStreet

HEIGHT, WIDTH = 40, 96
# disparity of a road below a far wall, in the networks' unit
SCENE = np.tile(np.maximum(np.linspace(-0.4, 1.0, HEIGHT), 0.05)[:, None], (1, WIDTH)).astype(
    np.float32
)
MakeNetwork = Callable[..., Path]
TRAJECTORY_ALONE = ["output.report=false", "mapping.enabled=false"]
PLAIN: dict[str, Any] = {"kind": "depth", "mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}
CheckRun = Callable[[Path], dict[str, Any]]
FRAMES = 18


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
def test_poses_get_the_unit_of_a_source_with_one_unit(gain: float):
    both = predictor(Source(gain))
    np.testing.assert_allclose(both.depth(frames()[0]), 1 / (gain * SCENE), rtol=1e-5)
    snippet = both.snippet(frames())
    np.testing.assert_allclose(shifts(snippet), 1 / gain, rtol=1e-5)
    assert (snippet.target, snippet.sources) == (2, (0, 1, 3, 4))
    np.testing.assert_array_equal(snippet.T_source_target[:, :3, :3], np.tile(np.eye(3), (4, 1, 1)))


@pytest.mark.parametrize(("align", "shift"), [("scale", 0.0), ("affine", 0.3), ("affine", -0.04)])
def test_each_frame_is_aligned_to_the_networks(align: Literal["scale", "affine"], shift: float):
    both = predictor(Source(7.0, shift), align)
    np.testing.assert_allclose(both.depth(frames()[0]), 1 / SCENE, rtol=1e-3)
    np.testing.assert_array_equal(shifts(both.snippet(frames())), 1.0)


def test_an_alignment_that_would_turn_near_into_far_is_a_scale():
    upside_down = Source(-1.0, 1.2)
    depth = predictor(upside_down, "affine").depth(frames()[0])
    known = np.isfinite(depth)
    assert known.all() and (depth > 0).all() and depth[0, 0] < depth[-1, 0]


def test_the_unit_of_a_frame_without_depth_is_that_of_the_nearest(caplog: pytest.LogCaptureFixture):
    both = predictor(Source(0.5, unknown=(1, 2, 3)))
    with caplog.at_level(logging.WARNING):
        assert np.isnan(both.depth(frames()[2])).all()
        assert np.isfinite(both.depth(frames()[4])).all()
    assert "frame 2 has no known depth in npy:depth" in caplog.text
    np.testing.assert_allclose(shifts(both.snippet(frames())), 2.0, rtol=1e-5)


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (10, 24), (80, 192), (20, 190)])
def test_depth_of_any_size_is_resized_and_unknown_pixels_do_not_spread(size: tuple[int, int]):
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


def folder_of(path: Path, names: list[str]) -> Path:
    """Frame k is k + 1 metres away."""
    path.mkdir(exist_ok=True)
    for k, name in enumerate(names):
        np.save(path / name, np.full((HEIGHT, WIDTH), k + 1.0, np.float32))
    return path


def opened(folder: Path, numbers: FrameNumbers, files: str = "npy", **settings: Any) -> DepthFolder:
    return DepthFolder(DepthConfig(source=f"{files}:{folder}", **settings), numbers, WIDTH, HEIGHT)


def metres(source: DepthFolder, index: int) -> float:
    disparity = source.disparity(*frames(index, 1))
    return float(1 / disparity[0, 0])


@pytest.mark.parametrize("first", [0, 1, 100])
def test_files_belong_to_frames_in_the_order_of_their_numbers(tmp_path: Path, first: int):
    folder = folder_of(tmp_path, [f"depth_{first + k}.npy" for k in range(12)])  # 9 before 10
    source = opened(folder, FrameNumbers(12, 0, 12))
    assert [metres(source, k) for k in range(12)] == pytest.approx(range(1, 13))


def test_a_range_of_frames_takes_its_own_files_of_the_whole_sequence(tmp_path: Path):
    folder = folder_of(tmp_path, [f"{k:06d}.npy" for k in range(10)])
    assert metres(opened(folder, FrameNumbers(4, 5, 10)), 0) == pytest.approx(6)
    assert metres(opened(folder, FrameNumbers(10, 300, 400)), 0) == pytest.approx(1), (
        "a folder of this range alone"
    )


def test_a_missing_number_is_an_error_only_if_its_frame_is_there(tmp_path: Path):
    names = [f"{k:06d}.npy" for k in range(8)]
    folder = folder_of(tmp_path, names)
    (folder / names[3]).unlink()
    source = opened(folder, FrameNumbers(8, 0, 8))
    assert metres(source, 4) == pytest.approx(5)
    with pytest.raises(SlamError, match="no depth for frame 3"):
        source.disparity(*frames(3, 1))


@pytest.mark.parametrize(("scale", "value"), [(256.0, 10.0), (1000.0, 2.56)])
def test_pictures_of_16_bits_have_a_scale_and_zero_is_unknown(
    tmp_path: Path, scale: float, value: float
):
    picture = np.full((HEIGHT, WIDTH), 2560, np.uint16)
    picture[0, 0] = 0
    cv2.imwrite(str(tmp_path / "000000.png"), picture)
    disparity = opened(tmp_path, FrameNumbers(1, 0, 1), "png", png_scale=scale).disparity(
        *frames(0, 1)
    )
    assert np.isnan(disparity[0, 0]) and disparity[5, 5] == pytest.approx(1 / value)


def test_disparity_may_be_given_and_axes_of_length_one_do_not_matter(tmp_path: Path):
    np.save(tmp_path / "0.npy", np.full((1, HEIGHT, WIDTH, 1), 0.125, np.float16))
    source = opened(tmp_path, FrameNumbers(1, 0, 1), kind="disparity")
    disparity = source.disparity(*frames(0, 1))
    assert disparity.shape == (HEIGHT, WIDTH) and (disparity == 0.125).all()


def test_the_digest_is_of_names_and_content(tmp_path: Path):
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


def test_mean_and_deviation_of_each_channel(make_network: MakeNetwork):
    source = opened_onnx(make_network(), mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
    pixel = np.array([100, 150, 200], np.uint8)
    wanted = ((pixel / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]).mean()
    np.testing.assert_allclose(source.infer(np.tile(pixel, (16, 32, 1))), wanted, rtol=1e-5)


def test_depth_and_disparity_are_told_apart_and_unknown_pixels_stay_unknown(
    make_network: MakeNetwork,
):
    frame = Frame(0, 0.0, np.concatenate([image(0), image(255)], axis=1)[:, ::2].copy())
    path = make_network(gain=2.0)
    far, near = opened_onnx(path, kind="disparity").disparity(frame)[0, [0, -1]]
    assert np.isnan(far) and near == pytest.approx(2.0)
    far, near = opened_onnx(path).disparity(frame)[0, [0, -1]]
    assert np.isnan(far) and near == pytest.approx(0.5)
    for shift in (np.nan, np.inf, -3.0):
        assert np.isnan(opened_onnx(make_network("bad.onnx", shift=shift)).disparity(frame)).all()


def test_a_network_that_fails_or_gives_no_map_is_found_at_once(make_network: MakeNetwork):
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


def test_the_size_is_that_of_the_file_or_is_set(make_network: MakeNetwork):
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


def test_weights_in_other_files_are_refused(make_network: MakeNetwork, tmp_path: Path):
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
        SlamError, match=r"split\.onnx cannot be run .*; copy or export it again, as one file"
    ):
        opened_onnx(tmp_path / "split.onnx")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """18 frames of a simulated street, with exact depth as pictures. Not to be changed."""
    root = tmp_path_factory.mktemp("depth") / "world"
    options = SimulationOptions(route="straight", frames=FRAMES, seed=1002, width=312, height=96)
    write_kitti_root(SimulatedStreet(options), root, depth=True)
    return root


def exact(world: Path) -> Path:
    return world / "sequences" / "sim" / "depth_2"


@pytest.fixture(scope="module")
def arrays(world: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same depth as arrays of half the size, in thirds of a metre; the sky is NaN."""
    folder = tmp_path_factory.mktemp("arrays")
    for path in sorted(exact(world).glob("*.png")):
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::2, ::2].astype(np.float32) / 256
        np.save(folder / f"{path.stem}.npy", np.where(depth > 0, 3 * depth, np.nan))
    return folder


@pytest.fixture(scope="module")
def exported(tiny_weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("onnxruntime")
    from erfsfm.checkpoint import load_model
    from erfsfm.export import export_onnx

    path = tmp_path_factory.mktemp("onnx") / "net.onnx"
    export_onnx(load_model(tiny_weights), path)
    return path


def positions(run: RunFolder, name: str = "optimised") -> np.ndarray:
    trajectory = run.trajectory(name)
    return trajectory.positions


def run(world: Path, output: Path, source: str, *overrides: str, **options: Any) -> RunFolder:
    given = [*TRAJECTORY_ALONE, f"depth.source={source}", *overrides]
    return run_slam(world, "sim", overrides=given, output=output, **{"weights": "sim", **options})


@pytest.mark.slow
def test_our_exported_network_gives_the_run_of_our_weights(
    world: Path, tiny_weights: Path, exported: Path, tmp_path: Path, check_run: CheckRun
):
    options = {"weights": tiny_weights, "frames": "0:9"}
    own = run(world, tmp_path / "own", "network", "output.report=true", **options)
    other = run(world, tmp_path / "other", f"onnx:{exported}", "output.report=true", **options)
    for name in ("network", "odometry", "optimised"):
        length = np.linalg.norm(positions(own, name)[-1])
        np.testing.assert_allclose(positions(other, name), positions(own, name), atol=2e-3 * length)
    provenance = check_run(other.path)["provenance"]
    assert (
        provenance["depth_source"] == f"onnx:{exported}" and len(provenance["depth_sha256"]) == 64
    )
    assert provenance["depth_sha256"] != provenance["weights_sha256"]
    before = check_run(own.path)["provenance"]
    assert (before["depth_source"], before["depth_sha256"]) == ("network", before["weights_sha256"])


@pytest.mark.slow
def test_exact_depth_gives_a_run_of_the_right_scale_in_any_unit(
    world: Path, arrays: Path, tmp_path: Path
):
    pictures = run(world, tmp_path / "png", f"png:{exact(world)}")
    metrics = pictures.metrics().tree()
    assert metrics["scale"]["value"] == pytest.approx(1.0, abs=0.06)
    aligned = metrics["trajectories"]["optimised"]["align"]
    assert (
        aligned["7dof"]["scale"] == pytest.approx(1.0, abs=0.06)
        and aligned["7dof"]["ate_rmse_m"] < 0.3
    )
    thirds = run(world, tmp_path / "npy", f"npy:{arrays}")
    assert thirds.metrics().tree()["scale"]["value"] == pytest.approx(1 / 3, rel=0.06)
    length = float(np.linalg.norm(positions(pictures)[-1]))
    np.testing.assert_allclose(positions(thirds), positions(pictures), atol=0.03 * length)
    (place,) = localise(world / "sequences/sim/image_2/000012.png", pictures)
    assert place.T_world_camera is None or place.nearest_frame is not None


def test_a_range_of_frames_and_a_blank_one(
    world: Path, arrays: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    folder = shutil.copytree(arrays, tmp_path / "arrays")
    np.save(folder / "000012.npy", np.full((48, 156), np.nan, np.float32))
    metrics = run(world, tmp_path / "run", f"npy:{folder}", frames="6:18").metrics().tree()
    assert metrics["status"] == "ok" and "frame 6 has no known depth" in caplog.text
    assert metrics["scale"]["value"] == pytest.approx(1 / 3, rel=0.06)


def test_depth_of_distorted_images_is_undistorted_with_them(world: Path, tmp_path: Path):
    depth, camera = exact(world) / "000000.png", tmp_path / "camera.yaml"
    camera.write_text(
        "width: 312\nheight: 96\nfx: 180\nfy: 180\ncx: 155\ncy: 45\nfps: 10\n"
        "model: opencv\ndistortion: [-0.2, 0.03, 0, 0]\n"
    )
    recording = open_sequence(world, "sim", camera)
    pinhole, lens = recording.intrinsics, recording.undistortion
    K, coefficients = (
        np.array([[180, 0, 155], [0, 180, 45], [0, 0, 1.0]]),
        np.array([-0.2, 0.03, 0, 0]),
    )
    maps = cv2.initUndistortRectifyMap(
        K, coefficients, np.eye(3), pinhole.K, (312, 96), cv2.CV_32FC1
    )
    stored = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED).astype(np.float32) / 256
    wanted = cv2.remap(stored, *maps, cv2.INTER_NEAREST)
    source = f"png:{exact(world)}"
    folder = DepthFolder(
        DepthConfig(source=source), FrameNumbers(FRAMES, 0, FRAMES), 312, 96, lens.apply_to_depth
    )
    found = 1 / folder.disparity(recording.frame(0))
    both = (wanted > 0) & np.isfinite(found)
    assert np.quantile(np.abs(found / wanted - 1)[both], 0.9) < 0.04  # half a pixel of the road
    np.testing.assert_array_equal(np.isfinite(found), wanted > 0)
    assert (
        run(world, tmp_path / "run", source, camera=camera, frames="0:7").metrics().status == "ok"
    )


def test_a_relative_network_is_aligned_in_each_frame(world: Path, tmp_path: Path):
    folder = tmp_path / "relative"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for path in sorted(exact(world).glob("*.png")):
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32) / 256
        disparity = np.where(depth > 0, 1 / np.maximum(depth, 0.1), 0)
        np.save(
            folder / f"{path.stem}.npy", rng.uniform(3, 30) * (disparity + 0.02).astype(np.float32)
        )
    chosen = ["depth.kind=disparity", "depth.align=affine"]
    metrics = run(world, tmp_path / "run", f"npy:{folder}", *chosen).metrics().tree()
    assert metrics["trajectories"]["optimised"]["align"]["7dof"]["scale"] == pytest.approx(
        1.0, abs=0.08
    )
    assert metrics["scale"]["spread"] < 0.15


def test_live_sessions_take_a_network_and_refuse_folders(
    world: Path, tiny_weights: Path, exported: Path, arrays: Path
):
    sequence = open_sequence(world, "sim")
    config = load_config(None, [f"depth.source=onnx:{exported}"])
    with Slam.from_weights(
        tiny_weights, sequence.intrinsics, config, sequence.camera_height_m
    ) as session:
        for k in range(6):
            session.add_frame(sequence.frame(k).image, 0.1 * k)
        assert len(session.trajectory()) == 6
    config = load_config(None, [f"depth.source=npy:{arrays}"])
    with pytest.raises(
        SlamError, match=r"npy:.* needs a whole sequence.*: choose network or onnx:FILE"
    ):
        Slam.from_weights(tiny_weights, sequence.intrinsics, config)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("tiff:depth", "should be network, onnx:FILE, npy:FOLDER or png:FOLDER; got 'tiff:depth'"),
        ("onnx:gone.onnx", "cannot read gone.onnx"),
        ("npy:short", "short has 17 frames of .npy"),
        ("npy:pickled", "pickled/000005.npy holds Python objects, which are not loaded"),
        ("npy:unknown", "frames 0 to 4 have no known depth in npy:unknown"),
        ("onnx:damaged.onnx", "damaged.onnx cannot be run by onnxruntime"),
    ],
)
def test_bad_sources_are_one_line_and_exit_1(
    world: Path,
    arrays: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command_line: Callable[..., tuple[int, str, str]],
    source: str,
    message: str,
):
    monkeypatch.chdir(tmp_path)
    (shutil.copytree(arrays, tmp_path / "short") / "000017.npy").unlink()
    np.save(
        shutil.copytree(arrays, tmp_path / "pickled") / "000005.npy",
        np.array([[print]]),
        allow_pickle=True,
    )
    (tmp_path / "unknown").mkdir()
    for k in range(FRAMES):
        np.save(
            tmp_path / "unknown" / f"{k}.npy",
            np.full((48, 156), [np.nan, 0.0, -1.0, np.inf][k % 4], np.float32),
        )
    (tmp_path / "damaged.onnx").write_bytes(b"\x08\x07" * 99)
    words = [
        "run",
        "--dataset",
        world,
        "--weights",
        "sim",
        "--output",
        "out",
        "--set",
        f"depth.source={source}",
    ]
    code, _, err = command_line(slam.commands.cli.main, "erfsfm-slam", *words)
    (line,) = [each for each in err.strip().splitlines() if not each.startswith("WARNING")]
    assert code == 1 and message in line
    assert (tmp_path / "out").exists() == (source == "npy:unknown"), (
        "all else is found before the run begins"
    )
