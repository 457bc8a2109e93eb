"""A run that is continued gives the bytes of a run in one go."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracle import OracleNoise, OraclePredictor

from slam import Slam, run_slam
from slam.config.sections import load_config
from slam.frames import Frame
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics
from slam.runtime.errors import RunError, SlamError
from slam.runtime.run_files import DRIVE, KEYFRAMES
from slam.sequences.catalogue import open_sequence
from slam.simulation.kitti_layout import write_kitti_root
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

SAME = (
    *(f"trajectory_{name}.tum.txt" for name in ("network", "odometry", "optimised")),
    *("reference.tum.txt", "graph.g2o", "loops.json", "places.npz", "map_mesh.ply", "map_cloud.ply"),
)
WEIGHTS = "sim"
SETTINGS = ["output.report=false", "output.keep=keyframes", "mapping.min_weight=1"]


def run(root: Path, output: Path, frames: str | None, **options: Any) -> RunFolder:
    options = {"overrides": SETTINGS, "weights": WEIGHTS} | options
    return run_slam(root, "sim", output=output, frames=frames, **options)


def rounded(tree: Any) -> Any:
    """Numbers to nine decimals: joining the reference of both parts rounds."""
    if isinstance(tree, dict):
        return {key: rounded(value) for key, value in tree.items()}
    return f"{tree + 0.0:.9f}" if isinstance(tree, float) else tree


@pytest.fixture(scope="module")
def whole(kitti_root: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """All 14 frames in one go. Not to be changed."""
    return run(kitti_root, tmp_path_factory.mktemp("runs") / "whole", None)


@pytest.fixture(scope="module")
def begun(kitti_root: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """The first 8 frames. Not to be changed."""
    return run(kitti_root, tmp_path_factory.mktemp("runs") / "begun", "0:8")


@pytest.fixture
def go_on(kitti_root: Path, begun: RunFolder, tmp_path: Path) -> Callable[..., RunFolder]:
    def go(frames: str | None = "8:", root: Path = kitti_root, **options: Any) -> RunFolder:
        output = options.pop("output", tmp_path / "continued")
        return run(root, output, frames, **{"overrides": (), "continues": begun.path} | options)

    return go


def test_every_file_has_the_bytes_of_a_run_in_one_go(
    whole: RunFolder, begun: RunFolder, go_on: Callable[..., RunFolder], monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[Path] = []
    read_metrics = Metrics.read
    monkeypatch.setattr(Metrics, "read", lambda path: read.append(path) or read_metrics(path))
    continued = go_on()
    assert read.count(begun.path / "metrics.json") == 1
    assert [name for name in SAME if (continued.path / name).read_bytes() != (whole.path / name).read_bytes()] == []
    metrics, wanted = continued.metrics().tree(), whole.metrics().tree()
    assert (metrics["sequence"].pop("continued_at"), wanted["sequence"].pop("continued_at")) == (8, 0)
    for part in ("sequence", "scale", "trajectories", "graph", "loops"):
        assert rounded(metrics[part]) == rounded(wanted[part])
    assert metrics["map"]["points"] == wanted["map"]["points"] > 0


def test_the_seed_and_the_gps_track_of_the_run_hold(kitti_root: Path, tmp_path: Path) -> None:
    track = tmp_path / "gps.csv"
    rows = [f"{0.1 * k:.1f},{49 + 1e-5 * k:.6f},8.4,100" for k in range(14)]
    track.write_text("\n".join(["stamp,latitude,longitude,altitude", *rows]))
    options: dict[str, Any] = {"overrides": ["output.report=false", "mapping.enabled=false", "gps.sigma_m=0.1"]}
    options |= {"gps": track, "seed": 7}
    once = run(kitti_root, tmp_path / "once", None, **options)
    before = run(kitti_root, tmp_path / "before", "0:8", **options).path
    continued = run(kitti_root, tmp_path / "after", "8:", overrides=(), continues=before)
    assert (continued.path / "graph.g2o").read_bytes() == (once.path / "graph.g2o").read_bytes()
    metrics, wanted = continued.metrics().tree(), once.metrics().tree()
    assert metrics["gps"]["fixes"] == wanted["gps"]["fixes"] == 14
    assert (metrics["provenance"]["seed"], metrics["provenance"]["recording"]["gps"]) == (7, str(track))
    track.unlink()
    with pytest.raises(RunError, match=r"gps\.csv, which is not there: give it with --gps FILE"):
        run(kitti_root, tmp_path / "none", "8:", overrides=(), continues=before)


@pytest.mark.slow
def test_frames_that_follow_have_their_true_depth(tmp_path: Path) -> None:
    street = SimulatedStreet(SimulationOptions(route="straight", frames=16, seed=1003, width=208, height=64))
    root = tmp_path / "root"
    write_kitti_root(street, root, depth=True, lidar=True)
    settings = ["output.report=false", "mapping.min_weight=1", "output.keep=keyframes"]
    before = run(root, tmp_path / "before", "0:7", overrides=settings).path
    metrics = run(root, tmp_path / "after", "8:", overrides=(), continues=before).metrics().tree()
    assert metrics["map"]["truth"] == "depth maps" and metrics["map"]["with_scale"]["accuracy_median_m"] < 1
    assert 0 < metrics["map"]["with_scale"]["in_field"]["share"] < 1
    assert 0 < metrics["depth"]["network"]["abs_rel"] < 0.5
    reason = metrics["trajectories"]["lidar_reason"]
    assert reason == "LiDAR scans are not used where a drive continues another folder"
    shutil.rmtree(root / "sequences/sim/depth_2")
    metrics = run(root, tmp_path / "without", "8:", overrides=(), continues=before).metrics().tree()
    assert all(reason in metrics[part][f"{name}_reason"] for part, name in (("map", "truth"), ("depth", "network")))


@pytest.mark.slow
def test_three_runs_in_a_row_give_the_graph_of_one(whole: RunFolder, kitti_root: Path, tmp_path: Path) -> None:
    """One of them is of a single frame."""
    settings = ["output.report=false", "mapping.enabled=false"]
    before = run(kitti_root, tmp_path / "0", "0:6", overrides=settings).path
    for frames in ("6:7", "7:"):
        before = run(kitti_root, tmp_path / frames[0], frames, continues=before, overrides=()).path
    assert (before / "graph.g2o").read_bytes() == (whole.path / "graph.g2o").read_bytes()


def test_images_before_the_checkpoint_are_not_read(
    whole: RunFolder, go_on: Callable[..., RunFolder], copy_of_kitti_root: Callable[[], Path]
) -> None:
    root = copy_of_kitti_root()
    for path in sorted((root / "sequences/sim/image_2").iterdir())[1:8]:  # the first tells the size
        path.write_bytes(b"gone")
    continued = go_on(root=root)
    assert (continued.path / "graph.g2o").read_bytes() == (whole.path / "graph.g2o").read_bytes()


def test_a_folder_with_stamps_from_zero_continues_the_drive(
    whole: RunFolder, begun: RunFolder, kitti_root: Path, tmp_path: Path
) -> None:
    """Images alone: the same poses, and no reference."""
    images = tmp_path / "images"
    images.mkdir()
    for path in sorted((kitti_root / "sequences/sim/image_2").iterdir())[8:]:
        shutil.copy(path, images)
    shutil.copy(kitti_root / "camera.yaml", images)
    continued = run_slam(images, weights=WEIGHTS, continues=begun.path, output=tmp_path / "out")
    found, wanted = continued.trajectory("optimised"), whole.trajectory("optimised")
    assert found is not None and wanted is not None
    np.testing.assert_array_equal(found.T_world_camera, wanted.T_world_camera)
    np.testing.assert_allclose(np.diff(found.stamps), 0.1, atol=1e-6)
    assert continued.trajectory("reference") is None


def test_without_kept_keyframes_the_map_begins_at_the_checkpoint(
    begun: RunFolder,
    go_on: Callable[..., RunFolder],
    whole: RunFolder,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    bare = Path(shutil.copytree(begun.path, tmp_path / "bare"))
    (bare / KEYFRAMES).unlink()
    continued = go_on(continues=bare)
    assert "the map begins at frame 8" in caplog.text
    assert continued.metrics().tree()["map"]["blocks"] < whole.metrics().tree()["map"]["blocks"]
    assert (continued.path / "graph.g2o").read_bytes() == (whole.path / "graph.g2o").read_bytes()


def test_graph_mapping_and_output_may_be_changed(go_on: Callable[..., RunFolder]) -> None:
    continued = go_on(overrides=["pose_graph.kernel=none", "mapping.enabled=false", "output.keep=nothing"])
    config = load_config(continued.path / "config.yaml")
    assert (config.pose_graph.kernel, config.output.keep) == ("none", "nothing")
    assert not (continued.path / DRIVE).exists() and not (continued.path / "map_mesh.ply").exists()


@pytest.mark.parametrize(
    "options, message",
    [
        ({"config": "default"}, "leave out --config"),
        (
            {"overrides": ["visual_odometry.max_corners=300"]},
            "visual_odometry cannot be changed for .*: leave out --set visual_odometry",
        ),
        ({"overrides": ["keyframes.use=never"]}, "keyframes cannot be changed for .*: leave out --set keyframes"),
        (
            {"overrides": ["mapping.width_px=96"]},
            "mapping.width_px and mapping.frame_stride are those of the keyframes",
        ),
    ],
    ids=["configuration", "visual_odometry", "keyframes", "map"],
)
def test_configuration_of_the_pass_over_the_frames_is_fixed(
    go_on: Callable[..., RunFolder], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(SlamError, match=message):
        go_on(**options)


def test_other_weights(go_on: Callable[..., RunFolder]) -> None:
    with pytest.raises(SlamError, match="was run with other weights"):
        go_on(weights="default")


def test_another_camera(go_on: Callable[..., RunFolder], tmp_path: Path) -> None:
    root = tmp_path / "wide"
    write_kitti_root(
        SimulatedStreet(SimulationOptions(route="straight", frames=6, seed=1002, width=240, height=64)), root
    )
    with pytest.raises(SlamError, match=r"taken with another camera, 240 x 64 .* 208 x 64"):
        go_on(root=root, frames=None)


def test_the_run_to_continue_is_not_overwritten(begun: RunFolder, go_on: Callable[..., RunFolder]) -> None:
    with pytest.raises(SlamError, match="is the run to continue, and would be lost"):
        go_on(output=begun.path)
    assert (begun.path / DRIVE).is_file()


def test_folders_that_cannot_be_continued(go_on: Callable[..., RunFolder], begun: RunFolder, tmp_path: Path) -> None:
    with pytest.raises(SlamError, match="not a run folder"):
        go_on(continues=tmp_path)
    bare = Path(shutil.copytree(begun.path, tmp_path / "bare"))
    (bare / DRIVE).write_bytes((bare / DRIVE).read_bytes()[:-1000])
    with pytest.raises(SlamError, match=r"drive.zip is damaged"):
        go_on(continues=bare)
    (bare / DRIVE).unlink()
    with pytest.raises(SlamError, match=r"cannot be continued: it has no drive.zip"):
        go_on(continues=bare)
    damaged = Path(shutil.copytree(begun.path, tmp_path / "damaged"))
    (damaged / KEYFRAMES).write_bytes(b"PK")
    with pytest.raises(SlamError, match=r"keyframes.npz is damaged"):
        go_on(continues=damaged)


@functools.cache
def street() -> SimulatedStreet:
    return SimulatedStreet(SimulationOptions(route="straight", frames=14, seed=1001, width=208, height=64))


def live(root: Path, **options: Any) -> Slam:
    sequence = open_sequence(root, "sim")

    def depth_of(index: int) -> np.ndarray:
        depth = street().depth(index)
        return np.where(depth > 0, depth, 200.0)

    assert sequence.reference is not None
    oracle = OraclePredictor(sequence.reference, depth_of, OracleNoise(np.deg2rad(0.3), 0.05, 0.005, 0.15, seed=3), 0.2)
    return Slam(oracle, sequence.intrinsics, camera_height_m=sequence.camera_height_m, **options)


def feed(slam: Slam, root: Path, frames: range) -> None:
    sequence = open_sequence(root, "sim")
    for index in frames:
        frame: Frame = sequence.frame(index)
        slam.add_frame(frame.image, frame.stamp)


@pytest.mark.parametrize("kind", [str, Path])
def test_live_slam_is_saved_and_resumed(kitti_root: Path, tmp_path: Path, kind: type[str | Path]) -> None:
    first = live(kitti_root)
    feed(first, kitti_root, range(8))
    first.save(kind(tmp_path / "drive.zip"))
    second = live(kitti_root)
    second.resume(kind(tmp_path / "drive.zip"))
    assert len(second) == 8
    first.close_loops()
    np.testing.assert_allclose(second.trajectory().positions, first.trajectory().positions, atol=1e-9)
    for slam in (first, second):
        feed(slam, kitti_root, range(8, 14))
    np.testing.assert_allclose(second.trajectory().positions, first.trajectory().positions, atol=1e-6)
    assert second.trajectory().length_m > 5


def test_live_slam_resumes_before_its_first_frame_with_the_same_camera(kitti_root: Path, tmp_path: Path) -> None:
    first = live(kitti_root)
    feed(first, kitti_root, range(6))
    first.save(tmp_path / "drive.zip")
    with pytest.raises(SlamError, match="before the first frame; there are 6 already"):
        first.resume(tmp_path / "drive.zip")
    with pytest.raises(SlamError, match="another camera, camera height or weights"):
        live(kitti_root, weights_sha256="9f").resume(tmp_path / "drive.zip")
    with pytest.raises(SlamError, match=r"was made with another keyframes\.use"):
        live(kitti_root, config=load_config(None, ["keyframes.use=always"])).resume(tmp_path / "drive.zip")
    with pytest.raises(SlamError, match="is missing"):
        live(kitti_root).resume(tmp_path / "none.zip")
