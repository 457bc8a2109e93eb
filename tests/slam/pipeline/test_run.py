"""The whole system on sequences with known poses, driven by an oracle in place of networks, mostly without images."""

from __future__ import annotations

import functools
import threading
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from oracle import OracleNoise, OraclePredictor

from erfsfm.common.errors import SHOW_TRACEBACK
from erfsfm.common.progress import Progress, silent
from slam.config.sections import load_config
from slam.evaluation.trajectory import trajectory_metrics
from slam.formats.trajectory import Trajectory, write_kitti, write_tum
from slam.frames import Frame, Image, Intrinsics, SnippetPoses
from slam.frontend import drive
from slam.frontend.visual.motion import triangulated
from slam.frontend.visual.odometry import STILL_SOURCE
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.pipeline.estimate import Estimate
from slam.pipeline.run import Recorder, SlamPipeline
from slam.runtime.errors import Failed, SlamError
from slam.sequences.catalogue import SimulatedSequence
from slam.simulation.options import SimulationOptions

CAMERA = Intrinsics(width=104, height=32, fx=60.0, fy=60.0, cx=51.5, cy=12.0)
HEIGHT_M = 1.5
FACTOR = 0.2  # unscaled lengths per metre
NO_NOISE = OracleNoise()
NO_IMAGES = ("visual_odometry.enabled=false", "mapping.enabled=false", "gaps.enabled=false")


class LevelRoad:
    """A sequence of a camera on a level road: poses and depth are exact, the images show nothing."""

    def __init__(self, T_world_camera: FloatArray, image: Image | None = None) -> None:
        self.name = "drive"
        self.intrinsics = CAMERA
        self.stamps = 0.1 * np.arange(len(T_world_camera))
        self.reference: FloatArray | None = T_world_camera
        self.camera_height_m: float | None = HEIGHT_M
        self.T_camera_lidar: FloatArray | None = None
        self.frames_read = 0
        self._image = np.full((32, 104, 3), 90, np.uint8) if image is None else image

    def __len__(self) -> int:
        return len(self.stamps)

    def frame(self, index: int) -> Frame:
        self.frames_read += 1
        return Frame(index, float(self.stamps[index]), self._image)

    def has_scan(self, index: int) -> bool:
        return self.T_camera_lidar is not None

    def scan(self, index: int) -> FloatArray:
        raise AssertionError("no scans")

    def provenance(self) -> tuple[str, ...]:
        return ()


def turning(frames: int) -> FloatArray:
    """Poses ``(N, 4, 4)`` of a level drive that bends left and right, at a changing speed."""
    k = np.arange(frames - 1)
    yaw = 0.05 * np.sin(k / 9.0)
    rotation_vector = np.stack([0 * yaw, yaw, 0 * yaw], axis=1)
    step = np.stack([0 * yaw, 0 * yaw, 1.0 + 0.2 * np.cos(k / 5.0)], axis=1)
    return se3.chain(se3.from_rotation_vector(rotation_vector, step))


def road(index: int) -> FloatArray:
    """z-depth of the level road up to a wall at 30 m."""
    below = np.arange(32) - CAMERA.cy
    depth = np.minimum(HEIGHT_M * CAMERA.fy / np.maximum(below, 1e-3), 30.0)
    return np.repeat(depth[:, None], 104, axis=1)


def run(
    drive: LevelRoad, *overrides: str, noise: OracleNoise = NO_NOISE, depth_of=road
) -> Estimate:
    assert drive.reference is not None
    oracle = OraclePredictor(drive.reference, depth_of, noise, FACTOR)
    return SlamPipeline(drive, oracle, load_config(None, [*NO_IMAGES, *overrides])).run()


def ate(estimate: Trajectory, reference: Trajectory | None) -> float:
    return float(trajectory_metrics(estimate, reference).align.dof7.ate_rmse_m)


def test_exact_predictions_give_the_true_trajectory() -> None:
    drive = LevelRoad(turning(60))
    result = run(drive)
    for each in (result.network, result.odometry, result.optimised, result.reference):
        assert each is not None and len(each) == 60
        np.testing.assert_array_equal(each.T_world_camera[0], np.eye(4))
        np.testing.assert_array_equal(each.stamps, drive.stamps)
    assert result.scale.mode == "camera-height"
    np.testing.assert_allclose(result.scale.per_frame, 1 / FACTOR, rtol=1e-5)
    np.testing.assert_allclose(result.network.positions, FACTOR * turning(60)[:, :3, 3], atol=1e-9)
    for each in (result.odometry, result.optimised):
        np.testing.assert_allclose(each.T_world_camera, turning(60), atol=1e-3)
    assert result.map is None and len(result.drive.steps) == 0
    assert len(result.drive.snippets) == 56 and len(result.factors) == 59


class OneBadSnippet(OraclePredictor):
    """An oracle that once gives no number."""

    def snippet(self, frames: list[Frame]) -> SnippetPoses:
        found = super().snippet(frames)
        return (
            replace(found, T_source_target=np.nan * found.T_source_target)
            if found.target == 20
            else found
        )


def test_a_pose_that_is_no_number_costs_a_gap() -> None:
    drive = LevelRoad(turning(60))
    assert drive.reference is not None
    oracle = OneBadSnippet(drive.reference, road, NO_NOISE, FACTOR)
    result = SlamPipeline(drive, oracle, load_config(None, NO_IMAGES)).run()
    assert [snippet.target for snippet in result.drive.trusted] == [*range(2, 20), *range(21, 58)]
    assert ate(result.optimised, result.reference) < 0.1


@pytest.mark.parametrize("stage", ["close_loops", "PoseGraph"])
def test_an_error_in_loops_or_graph_costs_these(
    stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object) -> None:
        raise KeyError(7)

    class Keeping(Recorder):
        def trajectory(self, name: str, trajectory: Trajectory) -> None:
            kept.append((name, len(trajectory)))

    drive, kept = LevelRoad(turning(30)), []
    assert drive.reference is not None
    pipeline = SlamPipeline(
        drive, OraclePredictor(drive.reference, road), load_config(None, NO_IMAGES)
    )
    monkeypatch.setattr(f"slam.pipeline.run.{stage}", failing)
    result = pipeline.run(Keeping())
    assert kept == [("reference", 30), ("network", 30), ("odometry", 30)]
    assert (
        result.loops.not_sought is not None
        and "KeyError: 7 (test_run.py:" in result.loops.not_sought
    )
    assert isinstance(result.graph, Failed) == (stage == "PoseGraph")
    assert ate(result.optimised, result.reference) < 1e-3
    monkeypatch.setenv(SHOW_TRACEBACK, "1")
    with pytest.raises(KeyError):
        pipeline.run()


def test_scale_drift_is_corrected_by_the_ground_plane() -> None:
    noise = OracleNoise(scale_drift_sigma=0.03)
    result = run(LevelRoad(turning(120)), noise=noise)
    drifted = result.network.length_m / FACTOR / turning_length(120)
    assert abs(np.log(drifted)) > 0.1
    assert result.optimised.length_m == pytest.approx(turning_length(120), rel=0.03)
    assert ate(result.optimised, result.reference) < 0.3 * ate(result.network, result.reference)


def turning_length(frames: int) -> float:
    return float(np.linalg.norm(np.diff(turning(frames)[:, :3, 3], axis=0), axis=1).sum())


@pytest.mark.parametrize(
    ("mode", "unit_m"),
    [("none", HEIGHT_M), ("camera-height", 1.0), ("reference", 1.0), ("auto", 1.0)],
)
def test_scale_modes(mode: str, unit_m: float) -> None:
    """``none`` measures in camera heights, the others in metres."""
    result = run(LevelRoad(turning(30)), f"scale.mode={mode}")
    assert result.scale.mode == ("camera-height" if mode == "auto" else mode)
    assert result.optimised.length_m * unit_m == pytest.approx(turning_length(30), rel=1e-4)
    assert not isinstance(result.scale.estimate, Failed)
    assert result.scale.estimate.value * FACTOR * unit_m == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize(
    ("frames", "setting", "words"),
    [
        (4, "scale.mode=auto", "drive has 4 frames, .* snippet .* has 5"),
        (30, "scale.mode=lidar", "scale.mode=lidar needs LiDAR scans of neighbouring frames"),
        (30, "lidar.factors=true", "lidar.factors=true needs LiDAR scans of neighbouring frames"),
        (30, "scale.mode=reference", "drive has none"),
        (30, "scale.mode=camera-height", "give a camera.yaml with camera_height_m"),
    ],
)
def test_what_cannot_work_is_refused_before_any_frame_is_read(
    frames: int, setting: str, words: str
) -> None:
    drive = LevelRoad(turning(frames))
    oracle = OraclePredictor(turning(frames), road)
    drive.reference = drive.camera_height_m = None
    pipeline = SlamPipeline(drive, oracle, load_config(None, [*NO_IMAGES, setting]))
    for begin in (pipeline.require_possible, pipeline.run):
        with pytest.raises(SlamError, match=words) as refused:
            begin()
        assert "\n" not in str(refused.value)
    assert drive.frames_read == 0


def test_lidar_factors_need_metres() -> None:
    drive = LevelRoad(turning(30))
    drive.camera_height_m, drive.T_camera_lidar = None, np.eye(4)
    pipeline = SlamPipeline(
        drive, OraclePredictor(turning(30), road), load_config(None, ["lidar.factors=true"])
    )
    with pytest.raises(
        SlamError, match=r"lidar\.factors=true is in metres.*choose scale\.mode=lidar"
    ):
        pipeline.require_possible()


def test_one_snippet_is_enough() -> None:
    result = run(LevelRoad(turning(5)))
    np.testing.assert_allclose(result.optimised.T_world_camera, turning(5), atol=1e-3)


def test_without_a_ground_plane_lengths_stay_unscaled_with_a_reason() -> None:
    result = run(LevelRoad(turning(20)), depth_of=lambda index: np.full((32, 104), 10.0))
    assert isinstance(result.scale.estimate, Failed) and "0 frames" in result.scale.estimate.reason
    np.testing.assert_array_equal(result.scale.per_frame, 1.0)
    assert result.optimised.length_m == pytest.approx(FACTOR * turning_length(20), rel=1e-3)


def threads(before: Collection[threading.Thread]) -> set[str]:
    """Names of the threads that a run starts and must end, of those that are alive and were not there ``before``."""
    prefixes = ("networks", "oracle", "beside", "ahead", "side")
    alive = (thread for thread in threading.enumerate() if thread not in before)
    return {thread.name for thread in alive if thread.name.startswith(prefixes)}


def test_threads_end_where_a_run_fails() -> None:
    """The depth of one frame cannot be computed: the error is the run's, and nothing goes on in the background."""

    def fails(index: int) -> FloatArray:
        if index == 12:
            raise RuntimeError("out of memory")
        return road(index)

    before = threading.enumerate()
    with pytest.raises(RuntimeError, match="out of memory"):
        run(LevelRoad(turning(30)), depth_of=fails)
    assert threads(before) == set()


def speckled() -> Image:
    noise = np.random.default_rng(0).integers(0, 255, (32, 104), np.uint8)
    return np.repeat(cv2.GaussianBlur(noise, (0, 0), 1.0)[..., None], 3, axis=2)


@pytest.mark.parametrize("mode", ["camera-height", "reference"])
def test_a_standing_camera_stays_at_the_origin(mode: str) -> None:
    still = LevelRoad(np.tile(np.eye(4), (40, 1, 1)), speckled())
    result = run(still, f"scale.mode={mode}")
    np.testing.assert_allclose(result.optimised.T_world_camera, still.reference, atol=1e-9)
    if mode == "reference":
        assert (
            isinstance(result.scale.estimate, Failed)
            and "does not move" in result.scale.estimate.reason
        )


def test_zero_optical_flow_suppresses_the_noise_of_the_pose_network() -> None:
    still = LevelRoad(np.tile(np.eye(4), (40, 1, 1)), speckled())
    noise = OracleNoise(np.deg2rad(0.3))
    options = ("visual_odometry.enabled=true",)
    result = run(still, *options, noise=noise)
    assert {motion.relative_pose.source for motion in result.drive.motions} == {STILL_SOURCE}
    rotation = [
        se3.rotation_angle(t.T_world_camera[:, :3, :3]).max()
        for t in (result.network, result.optimised)
    ]
    assert rotation[1] < 0.3 * rotation[0]
    np.testing.assert_array_equal(result.odometry.T_world_camera, still.reference)


def test_images_without_corners_leave_only_network_factors() -> None:
    result = run(LevelRoad(turning(20)), "visual_odometry.enabled=true")
    assert len(result.drive.steps) == 0
    pairs = [(first, second) for first, second, _ in result.drive.failures]
    assert pairs == [(k, k + 1) for k in range(19)]
    np.testing.assert_allclose(result.optimised.T_world_camera, turning(20), atol=1e-3)


STREET = 25


@pytest.fixture(scope="module")
def street() -> SimulatedSequence:
    sequence = SimulatedSequence(SimulationOptions("straight", 40, 1002, 208, 64))
    sequence.street.render = functools.cache(sequence.street.render)
    return sequence.cut(4, 4 + STREET)


def drive_street(
    street: SimulatedSequence,
    progress: Progress = silent,
    mode: str = "auto",
    sky: float = 200.0,
    stride: int = 2,
) -> Estimate:
    oracle = OraclePredictor(
        street.reference,
        lambda k: np.where((depth := street.true_depth(k)) > 0, depth, sky),
        OracleNoise(np.deg2rad(0.2), 0.05, 0.01, 0.03, seed=4),
        FACTOR,
    )
    settings = load_config(None, [f"scale.mode={mode}", f"depth.frame_stride={stride}"])
    return SlamPipeline(street, oracle, settings, progress).run()


@pytest.fixture(scope="module")
def driven(street: SimulatedSequence) -> tuple[Estimate, list[tuple[str, int, int]]]:
    """A run, and what it told of its progress."""
    calls: list[tuple[str, int, int]] = []
    return drive_street(street, lambda *words: calls.append(words)), calls


def test_two_runs_write_the_same_bytes(
    street: SimulatedSequence, driven: tuple[Estimate, list[tuple[str, int, int]]], tmp_path: Path
) -> None:
    """Corner detection, RANSAC and the threads of GTSAM and Open3D must not change the result."""
    for name, result in (("first", driven[0]), ("second", drive_street(street))):
        folder = tmp_path / name
        folder.mkdir()
        for stem in ("network", "odometry", "optimised"):
            write_kitti(folder / f"{stem}.kitti.txt", getattr(result, stem))
            write_tum(folder / f"{stem}.tum.txt", getattr(result, stem))
        result.graph.write_g2o(folder / "graph.g2o")
        assert result.map is not None
        result.map.surface().write_mesh(folder / "mesh.ply")
        result.map.surface().write_cloud(folder / "cloud.ply")
    for path in sorted((tmp_path / "first").iterdir()):
        assert path.read_bytes() == (tmp_path / "second" / path.name).read_bytes(), path.name


def test_images_reach_geometry_map_and_report(
    driven: tuple[Estimate, list[tuple[str, int, int]]],
) -> None:
    result, calls = driven
    solved = [("loops and graph", k, 1) for k in range(2)]
    assert calls == [("frames", k, STREET) for k in range(1, STREET + 1)] + solved + [
        ("map", k, 13) for k in range(1, 14)
    ]
    seen = result.drive
    assert len(seen.steps) > 15 and len(seen.steps) + len(seen.failures) == STREET - 1
    assert {f.ends for f in result.factors if f.source == "network"} == {
        (k, k + 1) for k in range(STREET - 1)
    }
    assert (
        len(seen.road_steps) > 10 and result.scale.lengths.keys() == triangulated(seen.steps).keys()
    )
    assert result.map is not None and result.map.statistics()["triangles"] > 5000
    assert {"read", "depth network", "pose network", "geometry", "graph", "map"} <= set(
        result.stopwatch.stages
    )


@pytest.mark.slow
def test_without_metres_the_map_is_as_fine_as_the_scene_is_near(street: SimulatedSequence) -> None:
    """In camera heights, which are no metres; depth of the sky is unknown."""
    result = drive_street(street, mode="none", sky=np.nan)
    depths = [street.true_depth(k) for k in range(0, STREET, 6)]
    nearness = np.median([np.median(depth[depth > 0]) for depth in depths]) / street.camera_height_m
    assert result.map is not None
    assert result.map.voxel_size == pytest.approx(0.2 * nearness / 15.0, rel=0.15)
    assert result.map.statistics()["triangles"] > 5000


def test_depth_is_thinned_for_the_map(
    street: SimulatedSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drive, "MAP_WIDTH_PX", 104)
    oracle = OraclePredictor(street.reference, lambda k: np.full((64, 208), 10.0))
    settings = load_config(None, ["visual_odometry.enabled=false"])
    seen = SlamPipeline(street, oracle, settings).run().drive
    assert seen.keyframes[0].image.shape == (32, 104, 3) and seen.keyframes[
        0
    ].depth_unscaled.shape == (32, 104)
