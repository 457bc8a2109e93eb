"""The whole system on sequences with known poses, driven by an oracle in place of networks, mostly without images."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import room
from oracle import OracleNoise, OraclePredictor, ate

from erfsfm.common.errors import SHOW_TRACEBACK
from erfsfm.common.progress import Progress, silent
from slam.config.sections import load_config
from slam.formats.trajectory import Trajectory, write_kitti, write_tum
from slam.frames import Frame, GpsTrack, Image, Intrinsics, SnippetPoses
from slam.frontend import measured
from slam.frontend.gps import LocalFrame, Location
from slam.frontend.visual.odometry import STILL_SOURCE
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.graph.pose_graph import PoseGraph
from slam.loops.features import FeatureExtractor
from slam.mapping.depth import DepthRefiner
from slam.mapping.submap import Fusion
from slam.pipeline.estimate import Estimate
from slam.pipeline.run import Recorder, SlamPipeline
from slam.runtime.errors import ConfigError, Failed, SlamError
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import SimulatedSequence

CAMERA = Intrinsics(width=104, height=32, fx=60.0, fy=60.0, cx=51.5, cy=12.0)
HEIGHT_M = 1.5
FACTOR = 0.2  # unscaled lengths per metre
NO_NOISE = OracleNoise()
NO_IMAGES = ("visual_odometry.enabled=false", "mapping.enabled=false", "gaps.enabled=false")
STREET = 25
GPS_FRAMES = 200
PLACE = np.array([49.0110, 8.4160, 115.0])
WITHOUT_LOOPS = ("loops.enabled=false", "keyframes.use=never")
# the first camera looks east: its x axis points south, its y axis down
T_ENU_WORLD = se3.make(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([5.0, -3.0, 1.0])
)
COUNTED_FRAMES = 30
# calls over frames: a step measured by geometry, whose tracks all pass the first search at best
MOST = {
    "depth": 0.6,
    "snippet": 0.3,
    "calcOpticalFlowPyrLK": 5.0,
    "findEssentialMat": 0.5,
    "goodFeaturesToTrack": 12.1,  # one a tile
    "view": 0.3,
    "refine": 0.7,
    "integrate": 0.7,
}


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
    oracle = OraclePredictor(drive.reference, depth_of, noise, FACTOR)
    return SlamPipeline(drive, oracle, load_config(None, [*NO_IMAGES, *overrides])).run()


def test_exact_predictions_give_the_true_trajectory():
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


def test_a_pose_that_is_no_number_costs_a_gap():
    drive = LevelRoad(turning(60))
    oracle = OneBadSnippet(drive.reference, road, NO_NOISE, FACTOR)
    result = SlamPipeline(drive, oracle, load_config(None, NO_IMAGES)).run()
    snippets = result.drive.measured.snippets
    assert [sources[0] for sources in snippets] == [*range(18), *range(19, 56)]
    assert ate(result) < 0.1


def test_a_step_that_no_camera_makes_begins_a_segment(monkeypatch: pytest.MonkeyPatch):
    truth, solve = room.walk(30), PoseGraph.optimise
    drive = LevelRoad(truth)
    drive.intrinsics, drive.camera_height_m = room.INTRINSICS, None
    monkeypatch.setattr(drive, "frame", lambda index: room.frame(index, truth[index]))

    def torn(graph: PoseGraph, T_world_camera: FloatArray) -> FloatArray:
        solved = solve(graph, T_world_camera)
        solved[20:, :3, 3] += 50.0
        return solved

    monkeypatch.setattr(PoseGraph, "optimise", torn)
    oracle = OraclePredictor(truth, lambda index: room.depth_map(truth[index]))
    settings = load_config(None, ["mapping.enabled=false", "keyframes.use=always"])
    result = SlamPipeline(drive, oracle, settings).run()
    assert [(part.first, part.last) for part in result.drive.segments] == [(0, 19), (20, 29)]


@pytest.mark.parametrize("stage", ["close_loops", "PoseGraph"])
def test_an_error_in_loops_or_graph_costs_these(stage: str, monkeypatch: pytest.MonkeyPatch):
    def failing(*_: object) -> None:
        raise KeyError(7)

    class Keeping(Recorder):
        def trajectory(self, name: str, trajectory: Trajectory) -> None:
            kept.append((name, len(trajectory)))

    drive, kept = LevelRoad(turning(30)), []
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
    assert ate(result) < 1e-3
    monkeypatch.setenv(SHOW_TRACEBACK, "1")
    with pytest.raises(KeyError):
        pipeline.run()


def test_scale_drift_is_corrected_by_the_ground_plane():
    noise = OracleNoise(scale_drift_sigma=0.03)
    result = run(LevelRoad(turning(120)), noise=noise)
    drifted = result.network.length_m / FACTOR / turning_length(120)
    assert abs(np.log(drifted)) > 0.1
    assert result.optimised.length_m == pytest.approx(turning_length(120), rel=0.03)
    assert ate(result) < 0.3 * ate(result, "network")


def turning_length(frames: int) -> float:
    return float(np.linalg.norm(np.diff(turning(frames)[:, :3, 3], axis=0), axis=1).sum())


@pytest.mark.parametrize(
    ("mode", "unit_m"),
    [("none", HEIGHT_M), ("camera-height", 1.0), ("reference", 1.0), ("auto", 1.0)],
)
def test_scale_modes(mode: str, unit_m: float):
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
):
    drive = LevelRoad(turning(frames))
    oracle = OraclePredictor(turning(frames), road)
    drive.reference = drive.camera_height_m = None
    pipeline = SlamPipeline(drive, oracle, load_config(None, [*NO_IMAGES, setting]))
    for begin in (pipeline.require_possible, pipeline.run):
        with pytest.raises(SlamError, match=words) as refused:
            begin()
        assert "\n" not in str(refused.value)
    assert drive.frames_read == 0


def test_lidar_factors_need_metres():
    drive = LevelRoad(turning(30))
    drive.camera_height_m, drive.T_camera_lidar = None, np.eye(4)
    pipeline = SlamPipeline(
        drive, OraclePredictor(turning(30), road), load_config(None, ["lidar.factors=true"])
    )
    with pytest.raises(
        SlamError, match=r"lidar\.factors=true is in metres.*choose scale\.mode=lidar"
    ):
        pipeline.require_possible()


def test_one_snippet_is_enough():
    result = run(LevelRoad(turning(5)))
    np.testing.assert_allclose(result.optimised.T_world_camera, turning(5), atol=1e-3)


def test_without_a_ground_plane_lengths_stay_unscaled_with_a_reason():
    result = run(LevelRoad(turning(20)), depth_of=lambda index: np.full((32, 104), 10.0))
    assert isinstance(result.scale.estimate, Failed) and "0 frames" in result.scale.estimate.reason
    np.testing.assert_array_equal(result.scale.per_frame, 1.0)
    assert result.optimised.length_m == pytest.approx(FACTOR * turning_length(20), rel=1e-3)


def threads(before: Collection[threading.Thread]) -> set[str]:
    """Names of the threads that a run starts and must end, of those that are alive and were not there ``before``."""
    prefixes = ("networks", "oracle", "beside", "ahead", "side")
    alive = (thread for thread in threading.enumerate() if thread not in before)
    return {thread.name for thread in alive if thread.name.startswith(prefixes)}


def test_threads_end_where_a_run_fails():
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
def test_a_standing_camera_stays_at_the_origin(mode: str):
    still = LevelRoad(np.tile(np.eye(4), (40, 1, 1)), speckled())
    result = run(still, f"scale.mode={mode}")
    np.testing.assert_allclose(result.optimised.T_world_camera, still.reference, atol=1e-9)
    if mode == "reference":
        assert (
            isinstance(result.scale.estimate, Failed)
            and "does not move" in result.scale.estimate.reason
        )


def test_zero_optical_flow_suppresses_the_noise_of_the_pose_network():
    still = LevelRoad(np.tile(np.eye(4), (40, 1, 1)), speckled())
    noise = OracleNoise(np.deg2rad(0.3))
    options = ("visual_odometry.enabled=true",)
    result = run(still, *options, noise=noise)
    assert {motion.relative_pose.source for motion in result.drive.steps.values()} == {STILL_SOURCE}
    rotation = [
        se3.rotation_angle(t.T_world_camera[:, :3, :3]).max()
        for t in (result.network, result.optimised)
    ]
    assert rotation[1] < 0.3 * rotation[0]
    np.testing.assert_array_equal(result.odometry.T_world_camera, still.reference)


def test_images_without_corners_leave_only_network_factors():
    result = run(LevelRoad(turning(20)), "visual_odometry.enabled=true")
    assert len(result.drive.steps) == 0
    assert [*result.drive.measured.failures] == [(k, k + 1) for k in range(19)]
    np.testing.assert_allclose(result.optimised.T_world_camera, turning(20), atol=1e-3)


@pytest.fixture(scope="module")
def street() -> SimulatedSequence:
    return SimulatedSequence(SimulationOptions("straight", 40, 1002, 208, 64)).cut(4, 4 + STREET)


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
):
    """Corner detection, RANSAC and the threads of GTSAM and Open3D must not change the result."""
    for name, result in (("first", driven[0]), ("second", drive_street(street))):
        folder = tmp_path / name
        folder.mkdir()
        for stem in ("network", "odometry", "optimised"):
            write_kitti(folder / f"{stem}.kitti.txt", getattr(result, stem))
            write_tum(folder / f"{stem}.tum.txt", getattr(result, stem))
        result.graph.write_g2o(folder / "graph.g2o")
        result.map.surface().write_mesh(folder / "mesh.ply")
        result.map.surface().write_cloud(folder / "cloud.ply")
    for path in sorted((tmp_path / "first").iterdir()):
        assert path.read_bytes() == (tmp_path / "second" / path.name).read_bytes(), path.name


def test_images_reach_geometry_map_and_report(driven: tuple[Estimate, list[tuple[str, int, int]]]):
    result, calls = driven
    solved = [("loops and graph", k, 1) for k in range(2)]
    assert calls == [("frames", k, STREET) for k in range(1, STREET + 1)] + solved + [
        ("map", k, 13) for k in range(1, 14)
    ]
    seen = result.drive
    assert len(seen.steps) > 15 and len(seen.steps) + len(seen.measured.failures) == STREET - 1
    assert {f.ends for f in result.factors if f.source == "network"} == {
        (k, k + 1) for k in range(STREET - 1)
    }
    assert len(seen.road_steps) > 10
    assert result.scale.lengths.keys() == seen.triangulated.keys()
    assert result.map is not None and result.map.statistics()["triangles"] > 5000
    assert {"read", "depth network", "pose network", "geometry", "graph", "map"} <= set(
        result.stopwatch.stages
    )


@pytest.mark.slow
def test_without_metres_the_map_is_as_fine_as_the_scene_is_near(street: SimulatedSequence):
    """In camera heights, which are no metres; depth of the sky is unknown."""
    result = drive_street(street, mode="none", sky=np.nan)
    depths = [street.true_depth(k) for k in range(0, STREET, 6)]
    nearness = np.median([np.median(depth[depth > 0]) for depth in depths]) / street.camera_height_m
    assert result.map.voxel_size == pytest.approx(0.2 * nearness / 15.0, rel=0.15)
    assert result.map.statistics()["triangles"] > 5000


def test_depth_is_thinned_for_the_map(street: SimulatedSequence, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(measured, "MAP_WIDTH_PX", 104)
    oracle = OraclePredictor(street.reference, lambda k: np.full((64, 208), 10.0))
    settings = load_config(None, ["visual_odometry.enabled=false"])
    seen = SlamPipeline(street, oracle, settings).run().drive
    assert seen.keyframes[0].image.shape == (32, 104, 3) and seen.keyframes[
        0
    ].depth_unscaled.shape == (32, 104)


def path() -> FloatArray:
    k = np.arange(GPS_FRAMES - 1)
    yaw = 0.03 * np.sin(k / 19.0)
    return se3.chain(
        se3.from_rotation_vector(
            np.stack([0 * yaw, yaw, 0 * yaw], 1), np.tile([0.0, 0.0, 1.0], (len(k), 1))
        )
    )


def track(rng: np.random.Generator, sigma_m: float, outliers: int = 0) -> GpsTrack:
    """Fixes four times a second between the frames."""
    stamps = np.arange(0.03, 19.9, 0.25)
    positions = se3.apply(T_ENU_WORLD, path()[:, :3, 3])
    points = np.column_stack(
        [np.interp(stamps, 0.1 * np.arange(GPS_FRAMES), positions[:, axis]) for axis in range(3)]
    )
    points += rng.normal(scale=sigma_m, size=points.shape)
    points[rng.choice(len(points), outliers, replace=False)] += [60.0, 40.0, 0.0]
    return GpsTrack(
        stamps, LocalFrame(PLACE).places(points), np.ones(len(stamps)), np.full(len(stamps), np.nan)
    )


def located(gps: GpsTrack | None, *overrides: str, noise: OracleNoise = NO_NOISE) -> Estimate:
    drive = LevelRoad(path())
    drive.camera_height_m = None
    config = load_config(None, [*NO_IMAGES, *WITHOUT_LOOPS, *overrides])
    oracle = OraclePredictor(path(), road, noise, FACTOR)
    return SlamPipeline(drive, oracle, config, gps_track=gps).run()


def worst(result: Estimate) -> float:
    """Largest distance from the truth, without any alignment, metres."""
    return float(np.linalg.norm(result.optimised.positions - path()[:, :3, 3], axis=1).max())


def test_exact_fixes_give_scale_and_place():
    result = located(
        track(np.random.default_rng(0), 0.0), "gps.sigma_m=0.1", "gps.vertical_sigma_m=0.1"
    )
    assert result.scale.mode == "gps" and result.scale.is_metric and worst(result) < 0.1
    location = result.location
    assert isinstance(location, Location)
    places = location.fixes.frame.places(
        (location.T_enu_world @ result.optimised.T_world_camera)[:, :3, 3]
    )
    true = LocalFrame(PLACE).places(se3.apply(T_ENU_WORLD, path()[:, :3, 3]))
    assert (
        np.linalg.norm(
            LocalFrame(PLACE).points(places) - LocalFrame(PLACE).points(true), axis=1
        ).max()
        < 0.1
    )


@pytest.mark.parametrize("correlation_s", [0, pytest.param(10, marks=pytest.mark.slow)])
def test_gps_holds_a_drifting_odometry_despite_outliers(correlation_s: int):
    noise = OracleNoise(np.deg2rad(0.3), 0.05, seed=1)
    gps = track(np.random.default_rng(1), 0.5, outliers=8)
    settings = ("gps.sigma_m=0.5", "gps.vertical_sigma_m=0.5", f"gps.correlation_s={correlation_s}")
    beside, within = (
        located(gps, *settings, f"gps.factors={use}", noise=noise) for use in ("false", "true")
    )
    assert beside.scale.estimate == within.scale.estimate
    positions = [r.location.T_enu_world @ r.optimised.T_world_camera for r in (beside, within)]
    frame = within.location.fixes.frame.points(
        LocalFrame(PLACE).places(se3.apply(T_ENU_WORLD, path()[:, :3, 3]))
    )
    errors = [float(np.linalg.norm(T[:, :3, 3] - frame, axis=1).mean()) for T in positions]
    assert errors[1] < 0.45 and 2 * errors[1] < errors[0]


def test_a_track_that_does_not_fit_is_refused():
    gps = track(np.random.default_rng(0), 0.0)
    with pytest.raises(SlamError, match=r"0 GPS fixes .* set gps\.offset_s"):
        located(gps, "gps.offset_s=100")
    with pytest.raises(SlamError, match=r"choose scale\.mode=gps"):
        located(gps, "scale.mode=none")
    with pytest.raises(SlamError, match="give --gps FILE"):
        located(None, "scale.mode=gps")


@pytest.mark.parametrize("change", ["backwards", pytest.param("late", marks=pytest.mark.slow)])
def test_fixes_of_another_drive_are_left_out_or_refused(
    change: str, caplog: pytest.LogCaptureFixture
):
    gps = track(np.random.default_rng(0), 0.0)
    places = gps.places[::-1] if change == "backwards" else np.roll(gps.places, 30, axis=0)
    other = GpsTrack(gps.stamps, places, gps.dilution, gps.speeds)
    settings = ("gps.sigma_m=0.2", "gps.vertical_sigma_m=0.2")
    result = located(other, *settings, "scale.mode=reference")
    found = next(each for each in result.agreements if each.source == "GPS")
    assert found.is_wrong and isinstance(result.location, Failed)
    assert caplog.text.count("GPS contradicts the images by") == 1
    with pytest.raises(SlamError, match="contradicts the images by"):
        located(other, *settings, "scale.mode=gps")


def test_a_camera_that_stands_is_not_located():
    gps = track(np.random.default_rng(0), 0.0)
    result = located(
        GpsTrack(gps.stamps, np.tile(PLACE, (len(gps.stamps), 1)), gps.dilution, gps.speeds)
    )
    assert isinstance(result.location, Failed) and "moves too little" in result.location.reason
    assert isinstance(result.scale.estimate, Failed) and result.scale.unit == "camera heights"


def test_fixes_in_metres_are_no_factors_of_lengths_that_are_not(caplog: pytest.LogCaptureFixture):
    """Long enough for the heading, too short for the scale."""
    gps = track(np.random.default_rng(0), 0.0)
    result = located(gps, "gps.sigma_m=5", "gps.correlation_s=0")
    assert isinstance(result.location, Failed)
    assert "0 stretches of a tenth of the fixes span over 25.0 m" in result.location.reason
    assert caplog.text.count("the camera moves too little") == 1
    assert result.optimised.length_m == pytest.approx(result.odometry.length_m, rel=1e-6)


@pytest.mark.parametrize("ends", ["[20,80]", "[8.04s,20]"])
def test_a_known_distance_gives_metres(ends: str):
    apart = float(np.linalg.norm(path()[80, :3, 3] - path()[20, :3, 3]))
    result = located(
        None, "scale.mode=known", f"scale.known_m={apart}", f"scale.known_between={ends}"
    )
    assert result.scale.mode == "known" and worst(result) < 0.05


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("[20,200]", "names 200, but the drive has frames 0 to 199"),
        ("[5,5]", "twice"),
        ("[30s,5]", "names 30s"),
    ],
)
def test_a_distance_between_frames_that_are_not_there(setting: str, said: str):
    with pytest.raises(SlamError, match=said):
        located(None, "scale.mode=known", "scale.known_m=3", f"scale.known_between={setting}")


def test_a_known_distance_needs_both_settings():
    for overrides in (
        ["scale.known_m=3"],
        ["scale.known_between=[1,2]"],
        ["scale.known_m=3", "scale.known_between=[a,2]"],
    ):
        with pytest.raises(ConfigError, match=r"known_m and known_between|stamps in seconds"):
            load_config(None, ["scale.mode=known", *overrides])


def counted(calls: Counter[str], name: str, of: Callable[..., Any]) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        calls[name] += 1
        return of(*args, **kwargs)

    return call


@pytest.mark.slow
def test_calls_a_frame(monkeypatch: pytest.MonkeyPatch):
    sequence, calls = (
        SimulatedSequence(SimulationOptions("grid", COUNTED_FRAMES, 610, 312, 96)),
        Counter[str](),
    )

    def depth_of(index: int) -> np.ndarray:
        depth = sequence.street.depth(index)
        return np.where(depth > 0, depth, 200.0)

    oracle = OraclePredictor(sequence.reference, depth_of, OracleNoise(), 0.2)
    for owner, name in (
        *(
            (cv2, name)
            for name in ("calcOpticalFlowPyrLK", "findEssentialMat", "goodFeaturesToTrack")
        ),
        (oracle, "depth"),
        (oracle, "snippet"),
        (FeatureExtractor, "view"),
        (DepthRefiner, "refine"),
        (Fusion, "integrate"),
    ):
        monkeypatch.setattr(owner, name, counted(calls, name, getattr(owner, name)))
    SlamPipeline(sequence, oracle, load_config(None, [])).run()
    a_frame = {name: calls[name] / COUNTED_FRAMES for name in MOST}
    assert all(a_frame.values())
    assert {name: calls for name, calls in a_frame.items() if calls > MOST[name]} == {}


def test_calls_a_frame_of_a_hand_held_camera(monkeypatch: pytest.MonkeyPatch):
    """Two searches of corners for the frame; for a keyframe, two in each keyframe that still finds some of them."""
    truth, calls = room.walk(40), Counter[str]()
    monkeypatch.setattr(
        cv2, "calcOpticalFlowPyrLK", counted(calls, "flow", cv2.calcOpticalFlowPyrLK)
    )
    keyframes = room.tracked(truth).segments[-1].keyframes
    assert 0 < calls["flow"] <= 2 * len(truth) + 16 * len(keyframes)
