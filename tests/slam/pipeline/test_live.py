"""Frames as they come: the same measurements, the same loops, the same trajectory as in one batch."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from slam import Slam
from slam.config import SlamConfig, load_config
from slam.errors import SlamError
from slam.frames import Frame
from slam.pipeline.batch import SlamPipeline
from slam.prediction.oracle import OracleNoise, OraclePredictor
from slam.sequences.simulation.sequence import SimulatedSequence
from slam.sequences.simulation.street import SimulationOptions

FACTOR = 0.2
FRAMES = 250
NOISE = OracleNoise(np.deg2rad(0.3), 0.05, 0.005, 0.15, seed=3)
SETTINGS = ["geometry.enabled=false", "mapping.enabled=false", "loops.frame_stride=3"]


@functools.cache
def drive() -> SimulatedSequence:
    sequence = SimulatedSequence(SimulationOptions("loop", FRAMES, 610, 312, 96))
    # image and depth of a frame come from one rendering
    sequence.street.render = functools.lru_cache(2)(sequence.street.render)
    return sequence


def oracle() -> OraclePredictor:
    def depth_of(index: int) -> np.ndarray:
        depth = drive().street.render(index).depth.astype(np.float64)
        return np.where(depth > 0, depth, 200.0)

    return OraclePredictor(drive().reference, depth_of, NOISE, FACTOR)


def started(config: SlamConfig, **options: int) -> Slam:
    return Slam(oracle(), drive().intrinsics, config, drive().camera_height_m, **options)


def feed(slam: Slam, first: int, stop: int) -> None:
    for k in range(first, stop):
        frame: Frame = drive().frame(k)
        slam.add_frame(frame.image, frame.stamp)


def test_incremental_and_batch_agree_after_the_same_loops() -> None:
    """To 0.1 % of the path, whatever the graph held on the way."""
    config = load_config(None, SETTINGS)
    slam = started(config, update_frames=25, sweep_frames=125)
    feed(slam, 0, FRAMES)
    batch = SlamPipeline(drive(), oracle(), config).estimate()
    loops = slam.close_loops()
    assert len(loops.accepted) >= 5
    assert [loop.ends for loop in loops.accepted] == [loop.ends for loop in batch.loops.accepted]
    live = slam.trajectory()
    np.testing.assert_array_equal(live.stamps, drive().stamps)
    np.testing.assert_array_equal(live.T_world_camera[0], np.eye(4))
    apart = np.linalg.norm(live.positions - batch.optimised.positions, axis=1).max()
    moved = np.linalg.norm(batch.odometry.positions - batch.optimised.positions, axis=1).max()
    assert apart < 1e-3 * batch.optimised.length_m < moved


def test_the_trajectory_grows_with_the_frames() -> None:
    slam = started(load_config(None, SETTINGS), update_frames=10)
    with pytest.raises(SlamError, match="before the first frame"):
        slam.trajectory()
    for count in (1, 4, 12, 20):
        feed(slam, len(slam), count)
        T_world_camera = slam.trajectory().T_world_camera
        assert T_world_camera.shape == (count, 4, 4)
        way = np.linalg.norm(T_world_camera[-1, :3, 3])
        assert way == 0.0 if count < 5 else 0.5 * count < way < 1.5 * count


def test_blank_frames_are_bridged() -> None:
    slam = started(load_config(None, SETTINGS))
    feed(slam, 0, 12)
    for k in range(12, 17):
        slam.add_frame(np.zeros((96, 312, 3), np.uint8), float(drive().stamps[k]))
        assert len(slam.trajectory()) == k + 1
    feed(slam, 17, 30)
    reference = drive().reference
    assert reference is not None
    assert np.linalg.norm(slam.trajectory().positions - reference[:30, :3, 3], axis=1).max() < 3.0


def test_wrong_frames_and_modes_are_refused() -> None:
    slam = started(load_config(None, SETTINGS))
    image = drive().frame(0).image
    with pytest.raises(ValueError, match=r"image must be \(96, 312, 3\) uint8; got \(96, 312\)"):
        slam.add_frame(image[..., 0], 0.0)
    slam.add_frame(image, 1.0)
    with pytest.raises(ValueError, match=r"stamps must increase; got 1\.0 after 1\.0"):
        slam.add_frame(image, 1.0)
    with pytest.raises(SlamError, match="reference wants a whole sequence"):
        started(load_config(None, ["scale.mode=reference"]))
    with pytest.raises(SlamError, match="wants camera_height_m"):
        Slam(oracle(), drive().intrinsics, load_config(None, ["scale.mode=camera-height"]))


def test_a_buffer_that_is_filled_anew_is_a_new_frame() -> None:
    """As of a camera's driver, which writes every image to the same place."""
    config = load_config(None, ["mapping.enabled=false", "loops.enabled=false"])
    slam, buffered = (started(config, sweep_frames=0) for _ in range(2))
    feed(slam, 0, 9)
    buffer = np.empty_like(drive().frame(0).image)
    for k in range(9):
        frame = drive().frame(k)
        buffer[:] = frame.image
        buffered.add_frame(buffer, frame.stamp)
    np.testing.assert_array_equal(buffered.trajectory().T_world_camera, slam.trajectory().T_world_camera)
