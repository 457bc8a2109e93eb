import re

import numpy as np
import pytest

from slam.config import ScaleConfig
from slam.frames import Intrinsics, RelativePose
from slam.frontend.failure import MeasurementFailure
from slam.frontend.scale.road_plane import (
    GroundPlane,
    estimate_scale,
    fit_ground_plane,
    rescaled,
    resolve_mode,
    scale_from_reference,
    scale_from_road,
    scale_track,
)

CAMERA = Intrinsics(416, 128, 240.0, 240.0, 207.5, 63.5)
CONFIG = ScaleConfig()
HEIGHT = 0.37


def road_depth(height: float = HEIGHT, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    pitch, roll = np.deg2rad(pitch_deg), np.deg2rad(roll_deg)
    normal = np.array([np.sin(roll), np.cos(roll) * np.cos(pitch), np.cos(roll) * np.sin(pitch)])
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    facing = rays @ normal
    return np.where(facing > 0.01, height / np.maximum(facing, 0.01), 40.0).astype(np.float32)


def spoiled(depth: np.ndarray, seed: int, noise: float = 0.05, outliers: float = 0.25) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = depth * (1 + noise * rng.normal(size=depth.shape))
    wrong = rng.random(depth.shape) < outliers
    return np.where(wrong, depth * rng.uniform(0.3, 0.9, depth.shape), depth).astype(np.float32)


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (4.0, 0.0), (-3.0, 2.0)])
def test_exact_plane(pitch, roll):
    road = fit_ground_plane(road_depth(pitch_deg=pitch, roll_deg=roll), CAMERA, CONFIG)
    assert isinstance(road, GroundPlane)
    assert road.height_unscaled == pytest.approx(HEIGHT, rel=1e-4)
    assert road.inlier_ratio == 1.0
    assert np.linalg.norm(road.normal) == pytest.approx(1.0)
    assert np.rad2deg(np.arctan2(road.normal[2], road.normal[1])) == pytest.approx(pitch, abs=0.05)


def test_scale_within_one_percent_under_noise_and_outliers():
    roads = [fit_ground_plane(spoiled(road_depth(), seed), CAMERA, CONFIG) for seed in range(20)]
    assert all(isinstance(road, GroundPlane) for road in roads)
    heights = np.array([road.height_unscaled for road in roads])
    np.testing.assert_allclose(heights, HEIGHT, rtol=0.02)
    estimate = scale_from_road(roads, 1.65, CONFIG)
    assert estimate.value == pytest.approx(1.65 / HEIGHT, rel=0.01)
    assert estimate.frames_used >= 15
    assert 0 < estimate.spread < 0.02


def test_a_car_ahead_does_not_move_the_road():
    depth = road_depth()
    depth[60:100, 170:245] = 3.0
    road = fit_ground_plane(depth, CAMERA, CONFIG)
    assert isinstance(road, GroundPlane)
    assert road.height_unscaled == pytest.approx(HEIGHT, rel=0.01)


def test_the_answer_is_the_same_every_time():
    depth = spoiled(road_depth(), 0)
    one, other = fit_ground_plane(depth, CAMERA, CONFIG), fit_ground_plane(depth, CAMERA, CONFIG)
    assert one.height_unscaled == other.height_unscaled


@pytest.mark.parametrize(
    ("depth", "reason"),
    [
        (np.full((128, 416), np.nan, np.float32), "not usable"),
        (np.full((128, 416), 12.0, np.float32), "no plane within 12 deg"),
        (road_depth(roll_deg=25.0), "no plane within 12 deg"),
        (
            np.random.default_rng(0).uniform(1, 30, (128, 416)).astype(np.float32),
            "no plane within|only .* one plane|tilted",
        ),
    ],
)
def test_what_is_no_road_is_refused_with_a_reason(depth, reason):
    refusal = fit_ground_plane(depth, CAMERA, CONFIG)
    assert isinstance(refusal, MeasurementFailure)
    assert re.search(reason, refusal.reason)


def test_without_a_height_the_unit_is_the_camera_height():
    roads = [GroundPlane(0.5, np.array([0.0, 1.0, 0.0]), 1.0)] * 9
    assert scale_from_road(roads, None, CONFIG).value == pytest.approx(2.0)
    assert scale_from_road(roads, 1.65, CONFIG).value == pytest.approx(3.3)


def test_over_time_the_median_rejects_wild_frames():
    rng = np.random.default_rng(0)
    ratios = 2.0 * np.exp(0.02 * rng.normal(size=200))
    ratios[:50] = rng.uniform(4, 9, 50)
    ratios[60:70] = [np.nan, np.inf, -1.0, 0.0, np.nan] * 2
    estimate = estimate_scale(ratios, CONFIG)
    assert estimate.value == pytest.approx(2.0, rel=0.01)
    assert estimate.spread == pytest.approx(0.02, rel=0.4)
    assert 120 <= estimate.frames_used <= 140


def test_too_few_frames_are_refused():
    refusal = estimate_scale(np.array([1.0, 1.1, np.nan, 1.0]), CONFIG)
    assert isinstance(refusal, MeasurementFailure)
    assert "only 3 frames" in refusal.reason
    assert isinstance(scale_from_road([MeasurementFailure("dark")] * 30, 1.65, CONFIG), MeasurementFailure)


def test_track_follows_a_breathing_unit_and_bridges_refusals():
    heights = np.where(np.arange(200) < 100, 0.50, 0.52)
    roads = [GroundPlane(h, np.array([0.0, 1.0, 0.0]), 1.0) for h in heights]
    roads[10:40] = [MeasurementFailure("no road")] * 30
    estimate = scale_from_road(roads, 1.0, CONFIG)
    track = scale_track(roads, 1.0, estimate, CONFIG)
    assert track.shape == (200,)
    assert track[0] == pytest.approx(2.0)
    assert track[60] == pytest.approx(2.0)
    assert track[-1] == pytest.approx(1 / 0.52)


def test_reference_compares_the_first_path_lengths():
    true = np.tile(np.eye(4), (100, 1, 1))
    true[:, 2, 3] = np.arange(100)
    unscaled = true.copy()
    unscaled[:50, 2, 3] *= 0.25
    estimate = scale_from_reference(unscaled, true, CONFIG)
    assert estimate.value == pytest.approx(4.0)
    assert estimate.frames_used == 50
    assert isinstance(scale_from_reference(true * 0 + np.eye(4), true, CONFIG), MeasurementFailure)


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


def test_rescaled_changes_lengths_only():
    T = np.eye(4)
    T[:3, 3] = [1.0, 2.0, 3.0]
    measured = RelativePose(3, 4, T, np.arange(1.0, 7.0), "network")
    metric = rescaled(measured, 2.0)
    np.testing.assert_array_equal(metric.T_from_to[:3, 3], [2.0, 4.0, 6.0])
    np.testing.assert_array_equal(metric.sigmas, [1, 2, 3, 8, 10, 12])
    np.testing.assert_array_equal(measured.T_from_to[:3, 3], [1.0, 2.0, 3.0])
    assert (metric.from_index, metric.to_index, metric.source) == (3, 4, "network")
