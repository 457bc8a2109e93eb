"""The ground plane fitted to drawn depth."""

from __future__ import annotations

import numpy as np
import pytest

from slam.frames import DepthMap, Intrinsics
from slam.frontend.ground_plane import GroundPlaneFitter
from slam.frontend.scale import ScaleEstimate, scale_from_road
from slam.frontend.visual.depth_error import DepthError

LEVEL_CAMERA = Intrinsics(416, 128, 240.0, 240.0, 207.5, 63.5)
HEIGHT = 0.37


def fit_ground_plane(depth: DepthMap, seed: int = 0) -> float | None:
    return GroundPlaneFitter(LEVEL_CAMERA, seed).fit(depth, DepthError())


def road_depth(height: float = HEIGHT, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    pitch, roll = np.deg2rad(pitch_deg), np.deg2rad(roll_deg)
    normal = np.array([np.sin(roll), np.cos(roll) * np.cos(pitch), np.cos(roll) * np.sin(pitch)])
    facing = LEVEL_CAMERA.rays(LEVEL_CAMERA.pixel_grid()) @ normal
    return np.where(facing > 0.01, height / np.maximum(facing, 0.01), 40.0).astype(np.float32)


def spoiled(
    depth: np.ndarray, seed: int, noise: float = 0.05, outliers: float = 0.25
) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = depth * (1 + noise * rng.normal(size=depth.shape))
    wrong = rng.random(depth.shape) < outliers
    return np.where(wrong, depth * rng.uniform(0.3, 0.9, depth.shape), depth).astype(np.float32)


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (4.0, 0.0), (-3.0, 2.0)])
def test_exact_plane(pitch, roll):
    road = fit_ground_plane(road_depth(pitch_deg=pitch, roll_deg=roll))
    assert road == pytest.approx(HEIGHT, rel=1e-4)


def test_scale_is_within_one_percent_under_noise_and_outliers():
    roads = [fit_ground_plane(spoiled(road_depth(), seed)) for seed in range(20)]
    assert all(isinstance(road, float) for road in roads)
    np.testing.assert_allclose(roads, HEIGHT, rtol=0.02)
    estimate = scale_from_road(roads, 1.65)
    assert isinstance(estimate, ScaleEstimate)
    assert estimate.value == pytest.approx(1.65 / HEIGHT, rel=0.01)
    assert estimate.frames_used >= 15
    assert 0 < estimate.spread < 0.02


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("unknown", [np.nan, np.inf, 0.0, -3.0])
def test_unknown_depth_is_left_out(unknown):
    depth = road_depth()
    depth[:, ::2] = unknown
    road = fit_ground_plane(depth)
    assert road == pytest.approx(HEIGHT, rel=1e-4)
    depth[:] = unknown
    assert fit_ground_plane(depth) is None


def test_a_car_ahead_does_not_move_the_road():
    depth = road_depth()
    depth[60:100, 170:245] = 3.0
    road = fit_ground_plane(depth)
    assert road == pytest.approx(HEIGHT, rel=0.01)


def test_two_seeds_give_other_ransac_draws_and_one_seed_the_same():
    depth = spoiled(road_depth(), 0)
    heights = [fit_ground_plane(depth, seed) for seed in (0, 1, 1, 2)]
    assert heights[1] == heights[2] and len(set(heights)) == 3
    np.testing.assert_allclose(heights, HEIGHT, rtol=0.02)


@pytest.mark.parametrize(
    "depth",
    [
        np.full((128, 416), np.nan, np.float32),
        np.full((128, 416), 12.0, np.float32),
        road_depth(roll_deg=25.0),
        np.random.default_rng(0).uniform(1, 30, (128, 416)).astype(np.float32),
    ],
    ids=["unknown", "wall", "tilted", "noise"],
)
def test_what_is_no_level_plane_is_refused(depth):
    assert fit_ground_plane(depth) is None
