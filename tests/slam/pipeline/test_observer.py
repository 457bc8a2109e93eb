"""One pass over the frames: damaged and missing ones are interpolated and reported."""

from __future__ import annotations

import functools
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from oracle import OracleNoise, OraclePredictor, ate

from slam.config.sections import SlamConfig, load_config
from slam.frames import Frame
from slam.frontend import tracking
from slam.frontend.gaps import INTERPOLATED_SOURCE
from slam.frontend.measured import Measured
from slam.frontend.tracking import LONGEST_STEP
from slam.frontend.visual.odometry import STILL_SOURCE
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.pipeline.estimate import Estimate
from slam.pipeline.observer import Observer
from slam.pipeline.run import SlamPipeline, read_frame
from slam.runtime.errors import MissingFrameError, SequenceError
from slam.runtime.stopwatch import Stopwatch
from slam.simulation import street as street_world
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import SimulatedSequence
from slam.simulation.route import Route, plan_route

FRAMES = 40
BAD = range(15, 25)
FACTOR = 0.2

Damage = Callable[[SimulatedSequence, int], Frame]


def black(sequence: SimulatedSequence, index: int) -> Frame:
    return Frame(index, float(sequence.stamps[index]), np.zeros((64, 208, 3), np.uint8))


def repeated_as_jpeg(sequence: SimulatedSequence, index: int) -> Frame:
    """A frozen camera in a compressed video: the same image, encoded anew each time."""
    quality = 60 + 3 * (index - BAD[0])
    _, encoded = cv2.imencode(
        ".jpg", sequence.frame(BAD[0] - 1).image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    decoded = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    return Frame(index, float(sequence.stamps[index]), np.ascontiguousarray(decoded[..., ::-1]))


def missing(sequence: SimulatedSequence, index: int) -> Frame:
    raise MissingFrameError(f"there is no image {index}.png")


def unreadable(sequence: SimulatedSequence, index: int) -> Frame:
    raise SequenceError(f"image {index}.png is truncated")


class Damaged:
    """A drive some of whose frames are damaged."""

    def __init__(self, sequence: SimulatedSequence, damage: Damage, bad: range) -> None:
        self._sequence, self._damage, self._bad = sequence, damage, bad
        self.name, self.intrinsics, self.stamps = (
            sequence.name,
            sequence.intrinsics,
            sequence.stamps,
        )
        self.reference, self.camera_height_m = sequence.reference, sequence.camera_height_m
        self.T_camera_lidar = None

    def __len__(self) -> int:
        return len(self._sequence)

    def frame(self, index: int) -> Frame:
        return (self._damage if index in self._bad else SimulatedSequence.frame)(
            self._sequence, index
        )

    def has_scan(self, index: int) -> bool:
        return False

    def scan(self, index: int) -> FloatArray:
        raise AssertionError("no scans")

    def provenance(self) -> tuple[str, ...]:
        return ()


@functools.cache
def street() -> SimulatedSequence:
    return SimulatedSequence(SimulationOptions("straight", FRAMES, 1004, 208, 64))


@pytest.fixture(autouse=True, scope="module")
def close_corners() -> Iterator[None]:
    """Images of the test are small."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracking, "STEP_CORNERS", tracking.STEP_CORNERS._replace(spacing_px=4.0))
        yield


def oracle_of(sequence: Damaged, rows: Sequence[int] = range(FRAMES)) -> OraclePredictor:
    def depth_of(index: int) -> np.ndarray:
        depth = street().street.depth(rows[index])
        return np.where(depth > 0, depth, 200.0)

    return OraclePredictor(
        sequence.reference, depth_of, OracleNoise(np.deg2rad(0.1), 0.03, seed=2), FACTOR
    )


def config_with(*overrides: str) -> SlamConfig:
    return load_config(None, overrides)


def run(damage: Damage = black, bad: range = BAD, *overrides: str) -> Estimate:
    sequence = Damaged(street(), damage, bad)
    return SlamPipeline(sequence, oracle_of(sequence), config_with(*overrides)).run()


@functools.cache
def run_on(damage: Damage) -> tuple[Estimate, str]:
    """A run with ten damaged frames, and its warnings."""
    lines: list[str] = []

    class Listing(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines.append(record.getMessage())

    listing = Listing(logging.WARNING)
    logger = logging.getLogger("slam")
    logger.addHandler(listing)
    try:
        return run(damage, BAD, f"mapping.enabled={str(damage is black).lower()}"), "\n".join(lines)
    finally:
        logger.removeHandler(listing)


@pytest.mark.parametrize(
    "damage",
    [
        black,
        pytest.param(repeated_as_jpeg, marks=pytest.mark.slow),
        pytest.param(missing, marks=pytest.mark.slow),
        unreadable,
    ],
    ids=lambda damage: damage.__name__,
)
def test_ten_frames_are_interpolated_and_reported(damage: Damage):
    result, warnings = run_on(damage)
    for each in (result.network, result.odometry, result.optimised):
        assert len(each) == FRAMES and np.isfinite(each.T_world_camera).all()
        np.testing.assert_array_equal(each.T_world_camera[0], np.eye(4))
    seen = result.drive
    assert set(seen.interpolated) == set(BAD)
    assert (
        warnings.count("are interpolated")
        == warnings.count("frames 15 to 24 are interpolated")
        == 1
    )
    interpolated = [factor for factor in result.factors if factor.source == INTERPOLATED_SOURCE]
    assert [factor.from_index for factor in interpolated] == list(range(14, 25))
    assert min(factor.sigmas[0] for factor in interpolated) > 5 * np.deg2rad(0.3)
    # the gap is ten metres of forty; standing still through it would cost more than a metre
    assert ate(result) < 0.6
    assert (result.map is not None) == (damage is black) and not {
        k.index for k in seen.keyframes
    } & set(BAD)
    assert not {view.index for view in seen.views} & set(BAD)


@pytest.mark.slow
def test_no_road_is_measured_in_the_sky():
    """Of images that are upside down."""

    def turned(sequence: SimulatedSequence, index: int) -> Frame:
        frame = sequence.frame(index)
        return replace(frame, image=np.ascontiguousarray(frame.image[::-1, ::-1]))

    config = config_with("mapping.enabled=false")
    drive = Damaged(street(), turned, range(FRAMES))
    found = SlamPipeline(drive, oracle_of(drive), config).run()
    assert (found.drive.measured.is_upside_down, len(found.drive.road_steps)) == (True, 0)
    assert any("180 degrees" in each.figure for each in found.agreements)
    assert not run_on(black)[0].drive.measured.is_upside_down


def test_doubled_frames_are_counted_and_cost_nothing():
    """Two frames come twice; the drive goes on where it was."""
    rows = sorted([*range(FRAMES - 2), 12, 25])

    class Doubled(Damaged):
        def frame(self, index: int) -> Frame:
            return replace(
                street().frame(rows[index]), index=index, stamp=float(street().stamps[index])
            )

    sequence = Doubled(street(), black, range(0))
    sequence.reference = street().reference[rows]
    result = SlamPipeline(
        sequence, oracle_of(sequence, rows), config_with("mapping.enabled=false")
    ).run()
    assert result.drive.doubled == [13, 27]
    assert result.drive.interpolated == {} and ate(result) < 0.6


def rolling_exposure(sequence: SimulatedSequence, index: int) -> Frame:
    frame = sequence.frame(index)
    image = np.clip(frame.image * (1.0 + 0.6 * np.sin(0.4 * index)), 0, 255).astype(np.uint8)
    return replace(frame, image=image)


@pytest.mark.slow
def test_rolling_exposure_is_reported(caplog: pytest.LogCaptureFixture):
    run(rolling_exposure, range(FRAMES), "mapping.enabled=false")
    assert "the exposure rolls: " in caplog.text


@pytest.mark.slow
def test_many_gaps_are_counted_in_one_line(caplog: pytest.LogCaptureFixture):
    bad = range(6, FRAMES - 1, 3)
    run(black, bad, "mapping.enabled=false")
    first = ", ".join(map(str, bad[:10]))
    assert f"frames {first}, ... are interpolated: the image is blank" in caplog.text
    assert caplog.text.count("interpolated") == 1


def test_an_undamaged_drive_has_no_interpolated_frames(caplog: pytest.LogCaptureFixture):
    assert (result := run(black, range(0), "mapping.enabled=false")).drive.interpolated == {}
    assert result.drive.doubled == [] and "exposure" not in caplog.text


def observe(frames: int, damage: Damage, bad: range, *overrides: str) -> Measured:
    """So many frames of a damaged drive."""
    sequence = Damaged(street(), damage, bad)
    config = config_with("mapping.enabled=false", "visual_odometry.enabled=false", *overrides)
    with Observer(oracle_of(sequence), sequence.intrinsics, config, Stopwatch()) as observer:
        for index in range(frames):
            observer.add(index, read_frame(sequence, index))
        return observer.finish()


def test_missing_images_never_end_a_run_and_unreadable_ones_do():
    """Thirty-four missing in a row are a gap in time; the thirty-first unreadable one is an error."""
    assert sorted(observe(FRAMES, missing, range(4, 38)).unusable) == list(range(4, 38))
    assert sorted(observe(34, unreadable, range(4, 38)).unusable) == list(range(4, 34))
    with pytest.raises(SequenceError, match=r"image 34\.png is truncated"):
        observe(35, unreadable, range(4, 38))


def test_a_missing_image_is_an_error_where_gaps_are_switched_off():
    with pytest.raises(MissingFrameError, match=r"there is no image 8\.png"):
        observe(20, missing, range(8, 10), "gaps.enabled=false")


def test_an_unreadable_image_raises_its_error_where_gaps_are_switched_off():
    with pytest.raises(SequenceError, match=r"image 15\.png is truncated"):
        run(unreadable, BAD, "gaps.enabled=false")


@pytest.mark.parametrize("stride", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_flushing_after_each_frame_measures_the_same_as_going_on(stride: int):
    sequence = Damaged(street(), black, range(12, 14))
    config = config_with("mapping.enabled=false", f"depth.frame_stride={stride}")
    going_on, flushed = (
        Observer(oracle_of(sequence), sequence.intrinsics, config, Stopwatch())
        for _ in ("going on", "flushed")
    )
    with going_on, flushed:
        for index in range(20):
            frame = sequence.frame(index)
            going_on.add(index, frame)
            flushed.add(index, Frame(index, frame.stamp, frame.image))
            flushed.flush()
            assert len(flushed.finish()) == flushed.frames == going_on.frames == index + 1
        assert_same(going_on, flushed)


def assert_same(one: Observer, other: Observer) -> None:
    """Both have measured the same bytes, of every kind."""
    one.flush()
    other.flush()
    first, second = one.measured, other.measured
    assert len(first.relative_rotations) > 8 and len(first.road_steps) > 5 and len(first.steps) > 10
    assert first.road_steps.keys() == second.road_steps.keys()
    for measured in (
        lambda o: [rotation.R_to_from for rotation in o.relative_rotations.values()],
        lambda o: [motion.relative_pose.T_from_to for motion in o.steps.values()],
        lambda o: [motion.relative_pose.sigmas for motion in o.steps.values()],
        lambda o: [snippet.T_source_target for snippet in o.snippets.values()],
        lambda o: [road for road in o.roads if road is not None],
        lambda o: [step.length_heights for step in o.road_steps.values()],
        lambda o: np.concatenate([view.points for view in o.views]),
    ):
        np.testing.assert_array_equal(measured(first), measured(second))
    assert first.steps.keys() == second.steps.keys()
    assert first.snippets.keys() == second.snippets.keys()
    assert [view.index for view in first.views] == [view.index for view in second.views]
    assert first.unusable == second.unusable and first.failures == second.failures


@pytest.mark.slow
def test_a_camera_that_moves_too_little_to_be_told_from_the_frame_before_does_not_stand(
    monkeypatch: pytest.MonkeyPatch,
):
    """It is compared with the last frame from which it can be told apart."""

    def crawling(*args: Any) -> Route:
        """A frame every two centimetres, for half of the frames; it stands in the others."""
        route = plan_route(*args)
        step = np.minimum(np.arange(2 * FRAMES), FRAMES) * 0.02
        T = route.T_street_camera[:1] @ se3.from_rotation_vector(
            np.zeros((2 * FRAMES, 3)), step[:, None] * np.array([0.0, 0.0, 1.0])
        )
        return replace(route, T_street_camera=T)

    monkeypatch.setattr(street_world, "plan_route", crawling)
    sequence = SimulatedSequence(SimulationOptions("straight", 2 * FRAMES, 3, 416, 128))
    depth = functools.cache(sequence.street.depth)
    noise = OracleNoise(np.deg2rad(0.1), 0.03, seed=2)
    predictor = OraclePredictor(
        sequence.reference, lambda k: np.where(depth(k) > 0, depth(k), 200.0), noise, FACTOR
    )
    config = config_with("mapping.enabled=false")
    result = SlamPipeline(sequence, predictor, config).run()
    errors = np.linalg.norm(
        result.optimised.T_world_camera[:, :3, 3] - sequence.reference[:, :3, 3], axis=1
    )
    assert errors.max() < 0.03
    still = {
        motion.ends[1]
        for motion in result.drive.steps.values()
        if motion.relative_pose.source == STILL_SOURCE
    }
    assert still.isdisjoint(range(FRAMES + 1))
    assert still.issuperset(range(FRAMES + LONGEST_STEP + 1, 2 * FRAMES))


def test_the_threads_of_an_observer_end_with_it():
    sequence = Damaged(street(), black, range(0))
    before = set(threading.enumerate())
    with Observer(oracle_of(sequence), sequence.intrinsics, config_with(), Stopwatch()) as observer:
        for index in range(8):
            observer.add(index, sequence.frame(index))
        assert {thread.name for thread in set(threading.enumerate()) - before} == {
            "oracle_0",
            "beside_0",
        }
    assert set(threading.enumerate()) <= before


def test_a_given_mask_holds_until_one_is_found():
    sequence = street()
    given, found = np.zeros(sequence.frame(0).grey.shape, bool), np.zeros((2, 4), bool)
    given[-4:], found[:, 0] = True, True
    with Observer(oracle_of(sequence), sequence.intrinsics, config_with(), Stopwatch()) as observer:
        observer.add(0, replace(sequence.frame(0), fixed=given))
        assert observer.measured.fixed is given
        observer.fixed.mask = found
        observer.add(1, replace(sequence.frame(1), fixed=given))
        assert observer.finish().fixed is found
