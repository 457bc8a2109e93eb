"""Optical flow predicted on a drawn road, and corners tracked through it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slam.frames import Frame, Intrinsics
from slam.frontend.tracking import CornerTracker, Tracks
from slam.frontend.visual.predicted_flow import PredictedFlow
from slam.geometry.epipolar import UnitRelativePose

CAMERA = Intrinsics(320, 120, 240.0, 240.0, 160.0, 40.0)
HEIGHT, LENGTH = 1.65, 1.1
FORWARDS = UnitRelativePose(np.eye(3), np.array([0.0, 0.0, -1.0]))
ROWS, COLUMNS = np.mgrid[:120, :320]


def road_depth() -> np.ndarray:
    """Depth of a level road below the horizon, NaN above."""
    below = (ROWS - CAMERA.cy) / CAMERA.fy
    return np.where(below > 0.02, HEIGHT / np.maximum(below, 0.02), np.nan).astype(np.float32)


def moved(pixels: np.ndarray) -> np.ndarray:
    """Of pixels ``(M, 2)`` on the road, after the camera went forwards by ``LENGTH``."""
    depth = HEIGHT * CAMERA.fy / (pixels[:, 1] - CAMERA.cy)
    centre = np.array([CAMERA.cx, CAMERA.cy])
    return centre + (pixels - centre) * (depth / (depth - LENGTH))[:, None]


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """A road with texture as fine near as far, seen from two positions."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (1024, 1024)).astype(np.float32), (0, 0), 1.2)
    depth = np.nan_to_num(road_depth(), nan=1e6)
    images = []
    for gone in (0.0, LENGTH):
        across = (COLUMNS - CAMERA.cx) / CAMERA.fx * depth
        grey = cv2.remap(
            texture,
            ((across * 14.0) % 1024).astype(np.float32),
            (((depth + gone) * 14.0) % 1024).astype(np.float32),
            cv2.INTER_LINEAR,
        )
        sharp = (grey - grey.mean()) * 3.0 + 128.0
        shown = np.where(np.isfinite(road_depth()), np.clip(sharp, 0, 255), 128.0).astype(np.uint8)
        images.append(np.repeat(shown[..., None], 3, axis=2))
    return [Frame(k, 0.1 * k, image) for k, image in enumerate(images)]


def predicted_flow(length: float = LENGTH) -> PredictedFlow:
    return PredictedFlow(FORWARDS, length, road_depth(), CAMERA)


def test_an_image_warped_back_by_the_right_flow_correlates_with_the_earlier_one(frames):
    first, second = (frame.grey for frame in frames)
    near = np.s_[60:95, 80:240]
    warped = predicted_flow().warp_back(second)

    def difference(image: np.ndarray) -> float:
        return float(np.abs(image[near].astype(float) - first[near]).mean())

    assert difference(warped) < 0.5 * difference(second)


def test_pixels_move_as_the_road_does():
    pixels = np.array([[100.0, 70.0], [200.5, 81.25], [160.0, 64.0]], np.float32)
    np.testing.assert_allclose(predicted_flow().in_current(pixels), moved(pixels), atol=0.02)
    assert predicted_flow().in_current(np.zeros((0, 2), np.float32)).shape == (0, 2)


def test_without_depth_only_the_rotation_is_predicted():
    turn, _ = cv2.Rodrigues(np.array([0.0, -0.02, 0.0]))
    unknown = np.full((120, 320), np.nan, np.float32)
    rotated = PredictedFlow(UnitRelativePose(turn, FORWARDS.direction), 5.0, unknown, CAMERA).in_current(
        np.array([[160.0, 40.0]], np.float32)
    )
    np.testing.assert_allclose(rotated, [[160.0 - 240.0 * np.tan(0.02), 40.0]], atol=1e-3)


def errors(tracks: Tracks) -> np.ndarray:
    on_the_road = (tracks.previous[:, 1] > 60) & (tracks.previous[:, 1] < 95)
    return tracks.current[on_the_road] - moved(tracks.previous[on_the_road])


def test_corners_on_the_road_are_tracked_through_the_predicted_flow(frames):
    """Also with a length that is wrong by a tenth, as learned depth is."""
    plain = errors(CornerTracker().track(*frames))
    predicted = errors(CornerTracker().track(*frames, predicted_flow(0.9 * LENGTH)))
    right_plain, right_predicted = ((np.abs(each).max(axis=1) < 0.3).sum() for each in (plain, predicted))
    assert right_predicted > max(2 * right_plain, 25)
    assert abs(np.median(predicted[:, 1])) < 0.15


def test_a_wrong_prediction_moves_corners_by_fractions_of_a_pixel(frames):
    """Of a standing camera whose flow is predicted as if it went on at full speed, by some ten pixels near the car."""
    still = [frames[0], Frame(1, 0.1, frames[0].image)]
    tracks = CornerTracker().track(*still, predicted_flow())
    assert len(tracks.track_ids) > 100
    median, most = np.quantile(np.abs(tracks.current - tracks.previous).max(axis=1), [0.5, 0.9])
    assert median < 0.15 and most < 0.7
