"""The unit of a run and the lengths of its steps, by mode, on a drawn drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.config.sections import ScaleConfig
from slam.frames import Ends, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.scale.metric_scale import (
    Scale,
    ScaleEstimate,
    find_scale,
    resolve_mode,
    scale_from_reference,
    scale_from_road,
    scale_track,
)
from slam.frontend.scale.road_homography import RoadStep
from slam.frontend.scale.road_plane import GroundPlane
from slam.frontend.visual.motion import Motion
from slam.geometry import se3
from slam.runtime.errors import Failed

DOWN = np.array([0.0, 1.0, 0.0])
HEIGHT_M = 1.65
UNIT = 0.05  # unscaled lengths per metre
STEPS_M = 1.0 + 0.2 * np.sin(np.arange(60) / 6.0)
FRAMES = len(STEPS_M) + 1
SINGLE = [(k, k + 1) for k in range(FRAMES - 1)]


def metres(ends: Ends) -> float:
    """True length of a straight step."""
    return float(STEPS_M[ends[0] : ends[1]].sum())


def step(ends: Ends, unit: float, source: str) -> RelativePose:
    T = se3.from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, unit * metres(ends)]))
    return RelativePose(*ends, T, np.ones(6), source)


def measured(
    road=True, planes=True, bias: float = 1.0, lidar: int = 0, height_m: float = HEIGHT_M, steps=SINGLE
) -> tuple[Drive, list[RelativePose]]:
    """A straight drive; ``bias`` makes the learned road lie too near, the first ``lidar`` steps have scans."""
    motions = [Motion(step(ends, UNIT, "essential"), np.eye(6)) for ends in steps]
    plane: GroundPlane | Failed = GroundPlane(bias * HEIGHT_M * UNIT, DOWN, 1.0) if planes else Failed("dark")
    roads = {ends: RoadStep(metres(ends) / height_m * DOWN, np.eye(3), DOWN, 0.06) for ends in steps} if road else {}
    scans = [step(ends, 1.0, "lidar") for ends in SINGLE[:lidar]]
    return Drive(roads=[plane] * FRAMES, motions=motions, road_steps=roads), scans


def find(mode, measurements: tuple[Drive, list[RelativePose]], height_m: float | None = HEIGHT_M) -> Scale:
    return find_scale(mode, height_m, *measurements)


def lengths(scale: Scale) -> dict[Ends, float]:
    return {ends: length.value for ends, length in scale.lengths.items()}


def assert_lengths(scale: Scale, expected: dict[Ends, float], rtol: float) -> None:
    found = lengths(scale)
    assert found.keys() == expected.keys()
    np.testing.assert_allclose([found[ends] for ends in expected], list(expected.values()), rtol=rtol)


TRUE_M = {ends: metres(ends) for ends in SINGLE}


@pytest.mark.parametrize(("mode", "unit_m"), [("camera-height", 1.0), ("none", HEIGHT_M), ("reference", HEIGHT_M)])
@pytest.mark.parametrize("planes", [True, False])
def test_the_road_in_the_image_outweighs_the_learned_road(mode, unit_m, planes):
    scale = find(mode, measured(planes=planes, bias=0.7))
    assert_lengths(scale, {ends: length / unit_m for ends, length in TRUE_M.items()}, rtol=0.02)
    np.testing.assert_allclose(scale.per_frame * unit_m, 1 / UNIT, rtol=0.03)
    assert isinstance(scale.estimate, ScaleEstimate)
    assert scale.estimate.frames_used == len(STEPS_M) and scale.estimate.spread < 0.02


def test_a_car_taken_for_the_road_for_half_the_drive_is_left_out():
    drive, scans = measured()
    drive.road_steps |= {ends: replace(drive.road_steps[ends], plane=0.1 * metres(ends) * DOWN) for ends in SINGLE[:30]}
    scale = find("camera-height", (drive, scans))
    assert_lengths(scale, TRUE_M, rtol=0.03)
    for length in scale.lengths.values():
        assert 0 < length.relative_sigma <= length.relative_correlated_sigma


def test_without_a_road_in_the_image_the_learned_road_stands():
    scale = find("camera-height", measured(road=False))
    assert_lengths(scale, TRUE_M, rtol=1e-4)
    assert isinstance(scale.estimate, ScaleEstimate)


def test_without_any_road_lengths_stay_unscaled():
    scale = find("camera-height", measured(road=False, planes=False))
    assert isinstance(scale.estimate, Failed)
    np.testing.assert_allclose(scale.per_frame, 1.0, rtol=1e-12)
    assert_lengths(scale, {ends: UNIT * length for ends, length in TRUE_M.items()}, rtol=1e-6)


@pytest.mark.parametrize("height_m", [0.35, 1.65, 3.2])
def test_lidar_gives_metres_where_no_road_step_and_no_height_is_known(height_m: float) -> None:
    scale = find("lidar", measured(road=False, bias=height_m / HEIGHT_M, lidar=20), None)
    assert scale.is_metric
    assert_lengths(scale, {ends: metres(ends) for ends in SINGLE}, 0.01)


def test_lidar_measures_its_steps_and_the_height_for_the_others():
    """The camera is really 2 m high; the height given is missing or wrong."""
    for given in (None, HEIGHT_M):
        scale = find("lidar", measured(lidar=20, height_m=2.0), given)
        assert_lengths(scale, TRUE_M, rtol=0.02)


def test_steps_that_skip_frames_have_lengths_by_their_two_frames():
    """Steps of three frames in the middle, and frames 40 to 45 without a step at all."""
    steps = [*SINGLE[:15], *((k, k + 3) for k in range(15, 39, 3)), (39, 40), *SINGLE[45:]]
    scale = find("camera-height", measured(bias=0.7, steps=steps))
    assert_lengths(scale, {ends: metres(ends) for ends in steps}, rtol=0.02)
    np.testing.assert_allclose(scale.per_frame, 1 / UNIT, rtol=0.04)  # of 36 %: few steps against the learned road
    assert scale.estimate.frames_used == len(steps)
    unscaled = find("camera-height", measured(road=False, planes=False, steps=steps))
    assert_lengths(unscaled, {ends: UNIT * metres(ends) for ends in steps}, rtol=1e-6)


def test_lengths_by_learned_depth_alone_have_the_unit_at_their_first_frames():
    """The unit of learned depth drifts by a tenth."""
    steps = [(k, k + 3) for k in range(0, FRAMES - 1, 3)]
    drifting = np.linspace(1.0, 1.1, FRAMES)
    planes = [GroundPlane(HEIGHT_M * UNIT / unit, DOWN, 1.0) for unit in drifting]
    scale = find("camera-height", (replace(measured(road=False, steps=steps)[0], roads=planes), []))
    assert scale.per_frame[-1] > 1.03 * scale.per_frame[0]
    for ends in steps:
        assert scale.lengths[ends].value == pytest.approx(scale.per_frame[ends[0]] * UNIT * metres(ends), rel=1e-4)


def test_the_unit_is_that_of_the_first_frame_of_a_measurement():
    scale = find("camera-height", measured())
    drifting = replace(scale, per_frame=np.arange(1.0, FRAMES + 1))
    ahead = np.array([0.0, 0.0, 1.0])
    for first, last, unit in ((4, 7, 5.0), (9, 6, 7.0)):
        measured_pose = RelativePose(first, last, se3.make(np.eye(3), ahead), np.ones(6), "network")
        np.testing.assert_allclose(drifting.scaled(measured_pose).T_from_to[:3, 3], unit * ahead)


def test_a_later_estimate_scales_everything_and_a_failure_nothing():
    scale = find("none", measured())
    doubled = scale.in_metres(ScaleEstimate(2.0, 0.1, 9))
    assert_lengths(doubled, {ends: 2.0 * length for ends, length in lengths(scale).items()}, rtol=1e-12)
    np.testing.assert_allclose(doubled.per_frame, 2.0 * scale.per_frame)
    assert isinstance(doubled.estimate, ScaleEstimate) and doubled.estimate.frames_used == 9
    refused = scale.in_metres(Failed("it stands"))
    assert refused.lengths == scale.lengths
    np.testing.assert_array_equal(refused.per_frame, scale.per_frame)
    assert refused.estimate == Failed("it stands")


@pytest.mark.parametrize(("share", "unit"), [(0.3, "no metric unit"), (0.7, "camera heights")])
def test_a_floor_seen_now_and_then_gives_no_metric_unit(share: float, unit: str) -> None:
    drive, scans = measured(road=False)
    seen = int(share * FRAMES)
    drive = replace(drive, roads=[*drive.roads[:seen], *[Failed("a table")] * (FRAMES - seen)])
    scale = find("none", (drive, scans), None)
    assert scale.unit == scale.unit_name == unit
    assert isinstance(scale.estimate, ScaleEstimate) and scale.estimate.frames_used == seen


@pytest.mark.parametrize(
    ("mode", "road", "unit"),
    [
        ("camera-height", True, "metres"),
        ("camera-height", False, "the networks' own unit"),
        ("none", True, "camera heights"),
        ("none", False, "the networks' own unit"),
        ("gps", True, "camera heights"),
        ("gps", False, "the networks' own unit"),
    ],
)
def test_lengths_have_the_unit_that_was_measured(mode, road, unit):
    scale = find(mode, measured(road=road, planes=road))
    assert scale.unit == scale.in_metres(Failed("the track is too short")).unit == unit
    assert scale.in_metres(ScaleEstimate(2.0, 0.1, 9)).unit == "metres"


def planes_of(heights) -> list[GroundPlane | Failed]:
    return [GroundPlane(height, DOWN, 1.0) for height in heights]


def test_without_a_height_the_unit_is_the_camera_height():
    roads = planes_of([0.5] * 9)
    assert scale_from_road(roads).value == pytest.approx(2.0)
    assert scale_from_road(roads, 1.65).value == pytest.approx(3.3)


def test_too_few_frames_give_no_scale():
    failure = scale_from_road([*planes_of([0.5] * 3), *[Failed("dark")] * 30], 1.65)
    assert isinstance(failure, Failed) and "only 3 frames" in failure.reason


def test_the_scale_track_follows_a_drifting_unit_across_frames_without_a_plane():
    heights = np.where(np.arange(200) < 100, 0.50, 0.52)
    roads = planes_of(heights)
    roads[10:40] = [Failed("no road")] * 30
    estimate = scale_from_road(roads, 1.0)
    track = scale_track(roads, 1.0, estimate)
    assert track.shape == (200,)
    assert track[0] == pytest.approx(2.0)
    assert track[60] == pytest.approx(2.0)
    assert track[-1] == pytest.approx(1 / 0.52)


def test_reference_compares_the_first_path_lengths():
    true = np.tile(np.eye(4), (100, 1, 1))
    true[:, 2, 3] = np.arange(100)
    unscaled = true.copy()
    unscaled[:50, 2, 3] *= 0.25
    estimate = scale_from_reference(unscaled, true)
    assert estimate.value == pytest.approx(4.0)
    assert estimate.frames_used == 50
    assert isinstance(scale_from_reference(true * 0 + np.eye(4), true), Failed)


@pytest.mark.parametrize(
    ("configured", "height", "mode"),
    [
        ("auto", 1.65, "camera-height"),
        ("auto", None, "none"),
        ("none", 1.65, "none"),
        ("reference", None, "reference"),
        ("lidar", 1.65, "lidar"),
    ],
)
def test_auto_stands_for_camera_height_where_it_is_known(configured, height, mode):
    assert resolve_mode(ScaleConfig(mode=configured), height) == mode
