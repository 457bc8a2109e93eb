"""Incremental SLAM: the same measurements, loops and trajectory as the batch pipeline."""

from __future__ import annotations

import functools
import threading
from dataclasses import replace

import numpy as np
import pytest
from oracle import OracleNoise, OraclePredictor

from slam import Slam
from slam.config.sections import SlamConfig, load_config
from slam.frames import DepthMap, Frame, SnippetPoses
from slam.geometry.se3 import apply, is_se3
from slam.pipeline.run import SlamPipeline
from slam.runtime.errors import SlamError
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import SimulatedSequence

FACTOR = 0.2
FRAMES = 250
NOISE = OracleNoise(np.deg2rad(0.3), 0.05, 0.005, 0.15, seed=3)
SETTINGS = ["visual_odometry.enabled=false", "mapping.enabled=false"]


@functools.cache
def drive() -> SimulatedSequence:
    return SimulatedSequence(SimulationOptions("loop", FRAMES, 610, 312, 96))


def oracle() -> OraclePredictor:
    def depth_of(index: int) -> np.ndarray:
        depth = drive().street.depth(index).astype(np.float64)
        return np.where(depth > 0, depth, 200.0)

    return OraclePredictor(drive().reference, depth_of, NOISE, FACTOR)


def started(config: SlamConfig, **options: int) -> Slam:
    return Slam(oracle(), drive().intrinsics, config, drive().camera_height_m, **options)


def feed(slam: Slam, first: int, stop: int) -> None:
    for k in range(first, stop):
        frame: Frame = drive().frame(k)
        slam.add_frame(frame.image, frame.stamp)


@pytest.mark.slow
def test_the_last_frames_are_measured_again_and_at_the_end_the_drive_as_in_one_run():
    config = load_config(None, SETTINGS)
    slam = started(config)
    feed(slam, 0, FRAMES - 9)
    before = slam.trajectory().T_world_camera
    feed(slam, FRAMES - 9, FRAMES)
    apart = np.abs(slam.trajectory().T_world_camera[: FRAMES - 9] - before).max(axis=(1, 2))
    assert apart[: FRAMES - 99].max() == 0.0 < apart[FRAMES - 99 :].max()
    batch = SlamPipeline(drive(), oracle(), config).run()
    loops = slam.close_loops()
    assert len(loops.accepted) >= 5
    assert [loop.ends for loop in loops.accepted] == [loop.ends for loop in batch.loops.accepted]
    live = slam.trajectory()
    np.testing.assert_array_equal(live.stamps, drive().stamps)
    np.testing.assert_array_equal(live.T_world_camera[0], np.eye(4))
    # a run looks ahead for what is fixed to the camera, a live session learns it on the way
    np.testing.assert_allclose(live.T_world_camera, batch.optimised.T_world_camera, atol=0.02)


def test_poses_of_the_whole_drive_stay_when_more_frames_come():
    slam = started(load_config(None, SETTINGS))
    feed(slam, 0, 32)
    slam.close_loops()
    before = slam.trajectory().T_world_camera
    feed(slam, 32, 41)
    np.testing.assert_array_equal(slam.trajectory().T_world_camera[:32], before)


def test_the_trajectory_grows_with_the_frames():
    slam = started(load_config(None, SETTINGS))
    with pytest.raises(SlamError, match="before the first frame"):
        slam.trajectory()
    for count in (1, 4, 12, 20):
        feed(slam, len(slam), count)
        T_world_camera = slam.trajectory().T_world_camera
        assert T_world_camera.shape == (count, 4, 4)
        distance = np.linalg.norm(T_world_camera[-1, :3, 3])
        assert distance == 0.0 if count < 5 else 0.5 * count < distance < 1.5 * count


def test_a_frame_gives_the_newest_pose_and_its_state():
    slam = started(load_config(None, SETTINGS))
    poses = [slam.add_frame(drive().frame(k).image, drive().frame(k).stamp) for k in range(20)]
    assert poses[0].state == "starting" and poses[-1].state == "tracking"
    assert [pose.frame for pose in poses] == sorted(pose.frame for pose in poses) and poses[
        -1
    ].frame >= 17
    np.testing.assert_allclose(
        poses[-1].T_world_camera, slam.trajectory().T_world_camera[poses[-1].frame], atol=1.0
    )


def test_a_session_gives_its_points_keyframes_marginals_and_surface():
    slam = started(load_config(None, SETTINGS), with_map=True)
    with pytest.raises(SlamError, match="too few usable frames"):
        slam.points()
    feed(slam, 0, 32)
    keyframes, points = slam.keyframes(), slam.points()
    assert set(keyframes.stamps) < set(slam.trajectory().stamps) and len(keyframes) == 8
    T_street_first = drive().street.T_world_camera[0]
    away = drive().street.distance_to_surface(
        apply(T_street_first, points[:: max(len(points) // 500, 1)])
    )
    assert len(points) > 500 and np.median(away) < 1.0
    near, far = (np.sqrt(np.diag(slam.marginals(frame))) for frame in (5, 31))
    assert (near > 0).all() and (near < far).all() and far[5] < 3.0, (
        "metres ahead, of 31 by learned poses alone"
    )
    vertices = np.asarray(slam.surface().vertices)
    assert (
        np.median(drive().street.distance_to_surface(apply(T_street_first, vertices[::50]))) < 1.0
    )
    clouds, poses = slam.clouds(first=10), slam.trajectory().T_world_camera
    assert min(clouds) >= 10 and set(clouds) <= set(range(32))
    for frame, cloud in clouds.items():
        seen = apply(T_street_first @ poses[frame], cloud[cloud[:, 2] < 10.0])
        assert len(seen) > 100 and np.median(drive().street.distance_to_surface(seen)) < 0.5
    with pytest.raises(SlamError, match="no frame 32"):
        slam.marginals(32)
    plain = started(load_config(None, SETTINGS))
    feed(plain, 0, 12)
    with pytest.raises(SlamError, match="make Slam with with_map=True"):
        plain.surface()


def test_the_camera_stays_at_its_place_until_there_is_a_unit():
    """Image geometry measures steps before the first snippet, but not their lengths."""
    slam = started(load_config(None, SETTINGS[1:]))
    for count in range(1, 5):
        feed(slam, len(slam), count)
        assert not slam.trajectory().positions.any() and slam.unit_name is None
    feed(slam, 4, 12)
    lengths = np.linalg.norm(np.diff(slam.trajectory().positions, axis=0), axis=1)
    assert slam.unit_name == "m" and lengths.min() > 0.5 and lengths.max() < 1.5


def test_blank_frames_are_interpolated():
    slam = started(load_config(None, SETTINGS))
    feed(slam, 0, 12)
    for k in range(12, 17):
        slam.add_frame(np.zeros((96, 312, 3), np.uint8), float(drive().stamps[k]))
        assert len(slam.trajectory()) == k + 1
    feed(slam, 17, 30)
    reference = drive().reference
    assert np.linalg.norm(slam.trajectory().positions - reference[:30, :3, 3], axis=1).max() < 3.0


def test_the_camera_stays_rigid_over_a_gap_longer_than_its_window():
    slam = started(load_config(None, SETTINGS))
    feed(slam, 0, 12)
    for k in range(12, 120):
        slam.add_frame(np.zeros((96, 312, 3), np.uint8), float(drive().stamps[k]))
    assert is_se3(slam.trajectory().T_world_camera, tolerance=1e-12)


def test_wrong_frames_and_modes_are_refused():
    slam = started(load_config(None, SETTINGS))
    image = drive().frame(0).image
    with pytest.raises(ValueError, match=r"image must be \(96, 312, 3\) uint8; got \(96, 312\)"):
        slam.add_frame(image[..., 0], 0.0)
    slam.add_frame(image, 1.0)
    for stamp in (1.0, 0.5, np.nan, np.inf, 1.7e18):
        with pytest.raises(ValueError, match="stamps must increase, in seconds; got"):
            slam.add_frame(image, stamp)
    assert len(slam) == 1 and slam.trajectory().stamps.tolist() == [1.0]
    with pytest.raises(SlamError, match="reference needs true poses; live has none"):
        started(load_config(None, ["scale.mode=reference"]))
    with pytest.raises(SlamError, match=r"lidar\.factors=true needs LiDAR scans"):
        started(load_config(None, ["lidar.factors=true"]))
    with pytest.raises(SlamError, match="camera-height needs a known height; live has none"):
        Slam(oracle(), drive().intrinsics, load_config(None, ["scale.mode=camera-height"]))
    with pytest.raises(SlamError, match="known needs frames of a whole sequence, and live grows"):
        started(
            load_config(None, ["scale.mode=known", "scale.known_between=[0,5]", "scale.known_m=3"])
        )


@pytest.mark.parametrize(
    "key, value",
    [
        ("fx", -200.0),
        ("fx", np.nan),
        ("cx", 1e6),
        ("width", 0),
        ("camera_height_m", 0.0),
        ("camera_height_m", np.nan),
    ],
)
def test_an_impossible_camera_is_refused(key: str, value: float):
    intrinsics, height = drive().intrinsics, {}
    if key == "camera_height_m":
        height = {key: value}
    else:
        intrinsics = replace(intrinsics, **{key: value})  # type: ignore[arg-type]
    with pytest.raises(SlamError, match=f"{key}.*"):
        Slam(oracle(), intrinsics, load_config(None, SETTINGS), **height)


def test_depth_that_is_no_depth_of_the_image_is_refused():
    class Small(OraclePredictor):
        def depth(self, frame: Frame) -> DepthMap:
            return super().depth(frame)[::2, ::2]

    predictor = oracle()
    predictor.__class__ = Small
    slam = Slam(predictor, drive().intrinsics, load_config(None, SETTINGS))
    with pytest.raises(
        SlamError, match=r"depth of frame 0 must be \(96, 312\) float32; got \(48, 156\)"
    ):
        feed(slam, 0, 2)


class Failing(OraclePredictor):
    """An oracle that fails at one frame, at its depth or at the snippet that ends with it, each time."""

    def __init__(self, frame: int, question: str) -> None:
        assert drive().reference is not None
        super().__init__(drive().reference, lambda k: np.full((96, 312), 10.0), NOISE, FACTOR)
        self._fails = question, frame

    def depth(self, frame: Frame) -> DepthMap:
        self._fail("depth", frame.index)
        return super().depth(frame)

    def snippet(self, frames: list[Frame]) -> SnippetPoses:
        self._fail("snippet", frames[-1].index)
        return super().snippet(frames)

    def _fail(self, question: str, index: int) -> None:
        if (question, index) == self._fails:
            raise RuntimeError(f"memory of frame {index} is gone")


@pytest.mark.parametrize("following", ["new", pytest.param("black", marks=pytest.mark.slow)])
@pytest.mark.parametrize("question", ["depth", "snippet"])
def test_a_frame_whose_measurement_fails_is_a_gap_and_the_session_goes_on(
    question: str, following: str, caplog: pytest.LogCaptureFixture
):
    """An error that nobody foresaw costs a frame: one row a frame, whether the next image is usable or not."""
    predictor = Failing(8, question)
    config = load_config(None, [*SETTINGS, "visual_odometry.enabled=true", "loops.enabled=false"])
    with Slam(predictor, drive().intrinsics, config, drive().camera_height_m) as slam:
        for k in range(20):
            frame = drive().frame(k)
            image = np.zeros_like(frame.image) if following == "black" and k == 9 else frame.image
            slam.add_frame(image, frame.stamp)
            assert len(slam) == k + 1
        trajectory = slam.trajectory()
    gaps = [record.getMessage() for record in caplog.records if "is a gap" in record.getMessage()]
    assert len(gaps) == 1 and "RuntimeError: memory of frame 8 is gone" in gaps[0]
    np.testing.assert_array_equal(trajectory.stamps, drive().stamps[:20])
    assert (
        trajectory.T_world_camera.shape == (20, 4, 4)
        and np.isfinite(trajectory.T_world_camera).all()
    )
    reference = drive().reference
    assert np.linalg.norm(trajectory.positions[-1]) > 0.5 * np.linalg.norm(reference[19, :3, 3])


def test_a_closed_session_has_no_threads_and_keeps_its_results():
    before = set(threading.enumerate())
    config = load_config(None, [*SETTINGS, "visual_odometry.enabled=true"])
    with started(config) as slam, started(config) as other:
        for each in (slam, other):
            feed(each, 0, 13)
        expected = other.trajectory().T_world_camera
        assert set(threading.enumerate()) - before
    assert set(threading.enumerate()) <= before
    np.testing.assert_array_equal(slam.trajectory().T_world_camera, expected)
    with pytest.raises(SlamError, match="this session is closed"):
        feed(slam, 13, 14)
    assert len(slam) == 13
    slam.close()


def test_a_buffer_that_is_reused_is_a_new_frame():
    """A camera driver may write every image to the same memory."""
    config = load_config(None, ["mapping.enabled=false", "loops.enabled=false"])
    slam, buffered = (started(config) for _ in range(2))
    feed(slam, 0, 9)
    buffer = np.empty_like(drive().frame(0).image)
    for k in range(9):
        frame = drive().frame(k)
        buffer[:] = frame.image
        buffered.add_frame(buffer, frame.stamp)
    np.testing.assert_array_equal(
        buffered.trajectory().T_world_camera, slam.trajectory().T_world_camera
    )
