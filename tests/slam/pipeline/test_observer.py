"""Ten frames in the middle of a drive show nothing: the run goes on, and says so."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slam.config import SlamConfig, load_config
from slam.errors import SequenceError
from slam.evaluation.trajectory import trajectory_metrics
from slam.frames import Frame
from slam.frontend.gap_interpolation import INTERPOLATED_SOURCE
from slam.pipeline.batch import SlamPipeline, SlamResult
from slam.pipeline.observer import Observer
from slam.prediction.oracle import OracleNoise, OraclePredictor
from slam.runtime.timing import Stopwatch
from slam.sequences.simulation.sequence import SimulatedSequence
from slam.sequences.simulation.street import SimulationOptions

FRAMES = 60
BAD = range(25, 35)
FACTOR = 0.2

Damage = Callable[[SimulatedSequence, int], Frame]


def black(sequence: SimulatedSequence, index: int) -> Frame:
    return Frame(index, float(sequence.stamps[index]), np.zeros((64, 208, 3), np.uint8))


def noise(sequence: SimulatedSequence, index: int) -> Frame:
    image = np.random.default_rng(index).integers(0, 255, (64, 208, 3), np.uint8)
    return Frame(index, float(sequence.stamps[index]), image)


def repeated(sequence: SimulatedSequence, index: int) -> Frame:
    return Frame(index, float(sequence.stamps[index]), sequence.frame(BAD[0] - 1).image)


def unreadable(sequence: SimulatedSequence, index: int) -> Frame:
    raise SequenceError(f"image {index}.png is truncated")


class Damaged:
    """A drive some of whose frames are damaged."""

    def __init__(self, sequence: SimulatedSequence, damage: Damage, bad: range) -> None:
        self._sequence, self._damage, self._bad = sequence, damage, bad
        self.name, self.intrinsics, self.stamps = sequence.name, sequence.intrinsics, sequence.stamps
        self.reference, self.camera_height_m = sequence.reference, sequence.camera_height_m
        self.T_camera_lidar = None

    def __len__(self) -> int:
        return len(self._sequence)

    def frame(self, index: int) -> Frame:
        return (self._damage if index in self._bad else SimulatedSequence.frame)(self._sequence, index)

    def scan_path(self, index: int) -> Path | None:
        return None

    def provenance(self) -> tuple[str, ...]:
        return ()


@functools.cache
def street() -> SimulatedSequence:
    return SimulatedSequence(SimulationOptions("straight", FRAMES, 1004, 208, 64))


def oracle_of(sequence: Damaged) -> OraclePredictor:
    def depth_of(index: int) -> np.ndarray:
        depth = street().street.render(index).depth
        return np.where(depth > 0, depth, 200.0)

    return OraclePredictor(sequence.reference, depth_of, OracleNoise(np.deg2rad(0.1), 0.03, seed=2), FACTOR)


def config_with(*overrides: str) -> SlamConfig:
    return load_config(None, ["geometry.corner_spacing_px=4", "geometry.min_inliers=20", *overrides])


def run(damage: Damage = black, bad: range = BAD, *overrides: str) -> SlamResult:
    sequence = Damaged(street(), damage, bad)
    return SlamPipeline(sequence, oracle_of(sequence), config_with("mapping.width_px=104", *overrides)).run()


@pytest.mark.parametrize("damage", [black, noise, repeated, unreadable], ids=lambda damage: damage.__name__)
def test_ten_frames_are_bridged_and_reported(damage: Damage, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        result = run(damage)
    for each in (result.network, result.odometry, result.optimised):
        assert len(each) == FRAMES and np.isfinite(each.T_world_camera).all()
        np.testing.assert_array_equal(each.T_world_camera[0], np.eye(4))
    seen = result.observations
    assert set(seen.bridged) == set(BAD)
    assert "frames 25 to 34 bridged: " in caplog.text
    interpolated = [factor for factor in result.factors if factor.source == INTERPOLATED_SOURCE]
    assert [factor.from_index for factor in interpolated] == list(range(24, 35))
    assert min(factor.sigmas[0] for factor in interpolated) > 5 * np.deg2rad(0.3)
    # the gap is ten metres of seventy; standing still through it would cost more than a metre
    errors = trajectory_metrics(result.optimised, result.reference)["align"]["7dof"]
    assert errors["ate_rmse_m"] < 0.6
    assert result.map is not None and not {k.index for k in seen.keyframes} & set(BAD)
    assert not {view.index for view in seen.views} & set(BAD)


def test_a_drive_in_order_is_left_alone() -> None:
    assert run(bad=range(0)).observations.bridged == {}


def test_too_many_unreadable_images_are_the_error_they_are() -> None:
    with pytest.raises(SequenceError, match=r"image 28\.png is truncated"):
        run(unreadable, BAD, "gaps.max_unread_frames=3")
    with pytest.raises(SequenceError, match=r"image 25\.png is truncated"):
        run(unreadable, BAD, "gaps.enabled=false")


def test_settling_after_each_frame_sees_the_same_as_going_on() -> None:
    sequence = Damaged(street(), black, range(12, 14))
    config = config_with("mapping.enabled=false")
    going_on, settling = (
        Observer(oracle_of(sequence), sequence.intrinsics, config, Stopwatch()) for _ in ("going on", "settling")
    )
    for index in range(24):
        frame = sequence.frame(index)
        going_on.add(index, frame)
        settling.add(index, frame)
        settling.flush()
        assert len(settling.seen.roads) == index + 1, "a settled observer has finished with every frame"
    late, soon = going_on.closed(), settling.closed()
    assert len(late.relative_rotations) > 10 and late.road_steps.keys() == soon.road_steps.keys()
    for seen in (
        lambda o: [span.R_to_from for span in o.relative_rotations],
        lambda o: [pose.T_from_to for pose in o.geometric],
    ):
        np.testing.assert_array_equal(seen(late), seen(soon))
    assert [snippet.target for snippet in late.snippets] == [snippet.target for snippet in soon.snippets]
    assert [view.index for view in late.views] == [view.index for view in soon.views]
