"""The length of a step by the homography of a drawn road, and of a car that pitches on its springs."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from slam.frames import Ends, Frame, Intrinsics, RelativePose
from slam.frontend.road import RoadHomography, RoadStep, with_slope
from slam.frontend.visual.motion import Motion, Steps
from slam.geometry import se3
from slam.geometry.se3 import FloatArray, invert, make
from slam.runtime.errors import Failed

CAMERA = Intrinsics(620, 188, 360.0, 360.0, 303.0, 92.0)
HEIGHT_M = 1.65
RAYS = CAMERA.rays(CAMERA.pixel_grid())
STEPS = 120
LENGTH_HEIGHTS = 0.6
AHEAD, DOWN = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def texture() -> np.ndarray:
    rng = np.random.default_rng(0)
    layers = [
        gaussian_filter(rng.normal(size=(1024, 1024)), sigma, mode="wrap") for sigma in (2, 6)
    ]
    noise = sum(layer / layer.std() for layer in layers)
    return np.clip(120 + 10 * noise, 0, 255).astype(np.float32)


def render(
    T_road_camera: np.ndarray, texture: np.ndarray, index: int, car_ahead: bool = False
) -> Frame:
    """A road ``HEIGHT_M`` below the road frame's origin under an even sky."""
    rays = RAYS @ T_road_camera[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (HEIGHT_M - T_road_camera[1, 3]) / rays[..., 1]
    ground = (reach > 0) & (reach < 80)
    points = T_road_camera[:3, 3] + rays * np.where(ground, reach, 0.0)[..., None]
    a, b = (np.float32(40.0) * points[..., axis].astype(np.float32) for axis in (0, 2))
    grey = np.where(ground, cv2.remap(texture, a % 1023, b % 1023, cv2.INTER_LINEAR), 200.0)
    if car_ahead:
        grey[100:140, 270:340] = 90.0  # it drives as fast as the camera
    return Frame(
        index, 0.1 * index, np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    )


def behind_a_car(texture: np.ndarray, rows: int) -> list[Frame]:
    """A step of 1 m; all that the camera shows in so many rows below the horizon drives as fast as it does."""
    car = np.random.default_rng(0).integers(0, 255, (rows, 300, 3), np.uint8)
    frames = [render(se3.make(np.eye(3), np.array([0.0, 0.0, k])), texture, k) for k in range(2)]
    for frame in frames:
        frame.image[92 : 92 + rows, 150:450] = cv2.GaussianBlur(car, (0, 0), 2.0)
    return frames


def pitched(pitch_deg: float) -> np.ndarray:
    return se3.from_rotation_vector(np.deg2rad([pitch_deg, 0.0, 0.0]), np.zeros(3))


def measure(
    texture, step: np.ndarray, pitch_deg: float = 0.0, car_ahead=False
) -> RoadStep | Failed:
    """One step of a camera that looks down by ``pitch_deg``; only the direction of its motion is given."""
    T_body_camera = pitched(-pitch_deg)
    previous = render(T_body_camera, texture, 0, car_ahead)
    current = render(step @ T_body_camera, texture, 1, car_ahead)
    T_previous_current = se3.invert(T_body_camera) @ step @ T_body_camera
    T_previous_current[:3, 3] *= 7.0
    return RoadHomography(CAMERA).measure(previous, current, T_previous_current)


@pytest.mark.parametrize("length_m", [0.15, 0.6, 1.3, 2.4])
@pytest.mark.parametrize(("turn_deg", "pitch_deg"), [(0.0, 0.0), (3.0, 0.0), (0.0, 3.0)])
def test_length_is_measured_in_camera_heights(texture, length_m, turn_deg, pitch_deg):
    step = se3.from_rotation_vector(
        np.deg2rad([0.0, turn_deg, 0.0]), np.array([0.0, 0.0, length_m])
    )
    road = measure(texture, step, pitch_deg)
    assert isinstance(road, RoadStep)
    assert road.length_heights * HEIGHT_M == pytest.approx(length_m, rel=0.02)
    assert np.rad2deg(np.arctan2(road.plane[2], road.plane[1])) == pytest.approx(pitch_deg, abs=0.3)
    assert 0.06 <= road.relative_sigma < 0.12


@pytest.mark.parametrize(("hidden_px", "within"), [(0, 0.005), (48, 0.02)])
def test_lengths_are_right_on_average(texture, hidden_px, within):
    """Also behind a bonnet that hides half of the image below the horizon, and most of the usual strip."""
    fixed, ratios = np.zeros((CAMERA.height, CAMERA.width), np.bool_), []
    fixed[CAMERA.height - hidden_px :] = True
    for k in range(16):
        T_road_camera = se3.make(np.eye(3), np.array([3.7 * k, 0.0, 11.3 * k % 20]))
        ahead = se3.make(np.eye(3), np.array([0.0, 0.0, 0.6 if k % 2 else 1.1]))
        places = T_road_camera, T_road_camera @ ahead
        frames = [replace(render(T, texture, i), fixed=fixed) for i, T in enumerate(places)]
        road = RoadHomography(CAMERA).measure(*frames, ahead)
        assert isinstance(road, RoadStep)
        ratios.append(road.length_heights * HEIGHT_M / ahead[2, 3])
    assert np.mean(ratios) == pytest.approx(1.0, abs=within)


def test_a_car_ahead_does_not_shorten_the_step(texture):
    step = se3.from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    road = measure(texture, step, car_ahead=True)
    assert isinstance(road, RoadStep)
    assert road.length_heights * HEIGHT_M == pytest.approx(1.0, rel=0.05)


def test_a_car_that_covers_the_road_is_refused(texture):
    """All that the strip shows far ahead drives as fast as the camera, and below it the road is even."""
    step = se3.from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    failure = RoadHomography(CAMERA).measure(*behind_a_car(texture, rows=90), step)
    assert isinstance(failure, Failed)


def test_before_a_car_that_hides_most_of_the_road_the_short_strip_measures(texture):
    step = se3.from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    frames = behind_a_car(texture, rows=76)
    road = RoadHomography(CAMERA).measure(*frames, step)
    assert isinstance(road, RoadStep)
    assert road.length_heights * HEIGHT_M == pytest.approx(1.0, rel=0.1)
    assert road.relative_sigma >= 0.1


def test_what_is_no_road_is_refused_with_a_reason():
    step = se3.from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    rng = np.random.default_rng(0)
    noise = [Frame(k, 0.0, rng.integers(0, 255, (188, 620, 3), np.uint8)) for k in range(2)]
    failure = RoadHomography(CAMERA).measure(*noise, step)
    assert isinstance(failure, Failed) and "do not correlate" in failure.reason
    even = [Frame(k, 0.0, np.full((188, 620, 3), 120, np.uint8)) for k in range(2)]
    for pitch in np.linspace(0.0, 1.0, 21):  # some of them leave a singular system
        tilted = se3.make(np.eye(3), np.array([0.0, np.sin(pitch), np.cos(pitch)]))
        assert isinstance(RoadHomography(CAMERA).measure(*even, tilted), Failed)
    sky = Intrinsics(620, 188, 360.0, 360.0, 303.0, 180.0)
    failure = RoadHomography(sky).measure(*noise, step)
    assert isinstance(failure, Failed) and "too little of the road" in failure.reason


def test_a_camera_that_looks_down_learns_its_pitch(texture):
    T_body_camera = pitched(-3.0)
    T_step = (
        se3.invert(T_body_camera) @ se3.make(np.eye(3), np.array([0.0, 0.0, 1.0])) @ T_body_camera
    )
    frames = [
        render(se3.make(np.eye(3), np.array([0.0, 0.0, k])) @ T_body_camera, texture, k)
        for k in range(3)
    ]
    level = se3.make(np.eye(3), np.array([0.0, 0.0, 1.0]))
    road = RoadHomography(CAMERA)
    road.measure(frames[0], frames[1], T_step)
    learned = road.measure(frames[1], frames[2], level)
    without = RoadHomography(CAMERA).measure(frames[1], frames[2], level)
    assert isinstance(learned, RoadStep)
    assert not isinstance(without, RoadStep) or without.length_heights != learned.length_heights


def pitches(degrees: float) -> FloatArray:
    return np.deg2rad(degrees) * np.sin(2 * np.pi * np.arange(STEPS + 1) / 14)


def drive(pitch: FloatArray, noise_deg: float = 0.0, missing: int | None = None) -> Steps:
    """Steps straight ahead on a level road; ``noise_deg`` is that of their directions, up and down."""
    rng = np.random.default_rng(0)
    R = Rotation.from_rotvec(np.outer(pitch, [1.0, 0.0, 0.0])).as_matrix()
    T_world_camera = np.array(
        [make(R[k], 7.0 * LENGTH_HEIGHTS * k * AHEAD) for k in range(STEPS + 1)]
    )
    motions = []
    for k in range(STEPS):
        T_current_previous = invert(T_world_camera[k + 1]) @ T_world_camera[k]
        off = Rotation.from_rotvec([np.deg2rad(noise_deg) * rng.normal(), 0.0, 0.0]).as_matrix()
        T_current_previous[:3, 3] = off @ T_current_previous[:3, 3]
        pose = RelativePose(k, k + 1, invert(T_current_previous), np.full(6, 0.01), "essential")
        motions.append(Motion(pose, 1e-6 * np.eye(6)))
    return {motion.ends: motion for motion in motions if motion.ends[0] != missing}


def road_steps(pitch: FloatArray) -> dict[Ends, RoadStep]:
    """As the images of a level road give them to a camera that is thought to be level."""
    v, u = np.mgrid[0.11:0.6:30j, -0.3:0.3:10j]
    rays = np.stack([u.ravel(), v.ravel(), np.ones(300)])
    information = 600.0 * (rays * rays[1] ** 2) @ rays.T
    steps = {}
    for k in range(STEPS):
        normal = np.array([0.0, np.cos(pitch[k + 1]), -np.sin(pitch[k + 1])])
        right = information @ (LENGTH_HEIGHTS * normal)
        steps[k, k + 1] = RoadStep(LENGTH_HEIGHTS * DOWN, information, right, 0.06).along(AHEAD)
    return steps


def error(steps: dict[Ends, RoadStep]) -> float:
    """Root mean square of relative errors."""
    return float(
        np.sqrt(
            np.mean([np.log(step.length_heights / LENGTH_HEIGHTS) ** 2 for step in steps.values()])
        )
    )


@pytest.mark.parametrize("degrees", [0.3, 1.0])
def test_the_path_tells_the_pitch_by_which_lengths_err(degrees: float):
    pitch = pitches(degrees)
    measured = road_steps(pitch)
    assert error(measured) > 0.02 * degrees
    assert error(with_slope(measured, drive(pitch))) < 0.3 * error(measured)


def test_noisy_directions_count_as_little_as_they_tell():
    pitch = pitches(0.3)
    measured, steps = road_steps(pitch), drive(pitch, noise_deg=1.0)
    back = invert(np.array([steps[ends].relative_pose.T_from_to for ends in measured]))[:, :3, 3]
    by_direction = {ends: measured[ends].along(-t) for ends, t in zip(measured, back, strict=True)}
    assert error(with_slope(measured, steps)) < 0.5 * error(by_direction)


def test_the_path_ends_where_a_step_is_missing():
    pitch = pitches(1.0)
    measured = road_steps(pitch)
    solved = with_slope(measured, drive(pitch, missing=60))
    assert solved.keys() == measured.keys() and solved[60, 61] is measured[60, 61]
    assert error(solved) < 0.5 * error(measured)
    assert with_slope(measured, {}) == measured
