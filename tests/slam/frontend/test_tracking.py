"""Corners tracked through drawn images that slide by whole pixels.

Optical flow predicted on a drawn road, and corners tracked through it.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slam.frames import Frame, Intrinsics
from slam.frontend.tracking import CornerTracker, PredictedFlow, Tracks
from slam.geometry.multiview import UnitRelativePose

SHIFT_PX = 4
CAMERA = Intrinsics(320, 120, 240.0, 240.0, 160.0, 40.0)
NARROW = Intrinsics(200, 120, 100.0, 100.0, 100.0, 60.0)
HEIGHT, LENGTH = 1.65, 1.1
FORWARDS = UnitRelativePose(np.eye(3), np.array([0.0, 0.0, -1.0]))
ROWS, COLUMNS = np.mgrid[:120, :320]


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """A wide image that slides to the left by whole pixels."""
    noise = np.random.default_rng(0).integers(0, 255, (120, 300), np.uint8)
    wide = np.repeat(cv2.GaussianBlur(noise, (0, 0), 1.5)[..., None], 3, axis=2)
    return [
        Frame(k, 0.1 * k, np.ascontiguousarray(wide[:, SHIFT_PX * k :][:, :200])) for k in range(6)
    ]


def test_tracks_move_with_the_image_and_keep_their_ids(frames):
    tracker = CornerTracker()
    first, second = tracker.track(frames[0], frames[1]), tracker.track(frames[1], frames[2])
    for tracks in (first, second):
        assert len(tracks.track_ids) == len(set(tracks.track_ids.tolist())) > 50
        error = np.abs(tracks.previous - tracks.current - [SHIFT_PX, 0]).max(axis=1)
        assert np.median(error) < 0.01 and error.max() < 0.5
    common, one, other = np.intersect1d(first.track_ids, second.track_ids, return_indices=True)
    assert len(common) > 0.8 * len(first.track_ids)
    np.testing.assert_array_equal(first.current[one], second.previous[other])


def test_new_corners_are_detected_in_what_slides_into_view(frames):
    tracker = CornerTracker()
    for k in range(5):
        tracks = tracker.track(frames[k], frames[k + 1])
    fresh = tracks.previous[tracks.track_ids > np.median(tracks.track_ids)]
    assert len(tracks.track_ids) > 50
    assert fresh[:, 0].max() > 200 - 3 * SHIFT_PX


def test_few_corners_are_tracked_again_with_equal_exposure(frames, monkeypatch):
    dark = Frame(1, 0.1, (0.35 * frames[1].image.astype(np.float32)).astype(np.uint8))
    monkeypatch.setattr("slam.frontend.tracking.FEW_CORNERS", 0)
    once = CornerTracker().track(frames[0], dark)
    monkeypatch.setattr("slam.frontend.tracking.FEW_CORNERS", 1000)
    again = CornerTracker().track(frames[0], dark)
    assert len(again.track_ids) > max(2 * len(once.track_ids), 40)
    error = np.abs(again.previous - again.current - [SHIFT_PX, 0]).max(axis=1)
    assert np.median(error) < 0.1


def test_corners_are_tracked_across_two_frames_through_the_predicted_flow(frames):
    tracker = CornerTracker()
    tracks = [tracker.track(frames[0], frames[1]), tracker.track(frames[1], frames[2])]
    sliding = UnitRelativePose(np.eye(3), np.array([-1.0, 0.0, 0.0]))
    too_far = 2 * SHIFT_PX * 10.0 / 100.0 + 0.05  # by half a pixel
    predicted = PredictedFlow(sliding, too_far, np.full((120, 200), 10.0, np.float32), NARROW)
    across = tracker.track_across(frames[0], frames[2], predicted)()
    assert len(across.track_ids) > 0.8 * len(tracks[0].track_ids)
    assert np.isin(across.track_ids, tracks[0].track_ids).all()
    error = np.abs(across.previous - across.current - [2 * SHIFT_PX, 0]).max(axis=1)
    assert np.median(error) < 0.02 and error.max() < 0.5


def test_lost_corners_are_not_tracked_across(frames):
    nothing = PredictedFlow(FORWARDS, 0.0, np.ones((120, 200), np.float32), NARROW)
    assert len(CornerTracker().track_across(frames[0], frames[2], nothing)().track_ids) == 0


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
def road_frames() -> list[Frame]:
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


def test_without_depth_only_the_rotation_is_predicted():
    turn, _ = cv2.Rodrigues(np.array([0.0, -0.02, 0.0]))
    unknown = np.full((120, 320), np.nan, np.float32)
    rotated = PredictedFlow(
        UnitRelativePose(turn, FORWARDS.direction), 5.0, unknown, CAMERA
    ).in_current(np.array([[160.0, 40.0]], np.float32))
    np.testing.assert_allclose(rotated, [[160.0 - 240.0 * np.tan(0.02), 40.0]], atol=1e-3)


def errors(tracks: Tracks) -> np.ndarray:
    on_the_road = (tracks.previous[:, 1] > 60) & (tracks.previous[:, 1] < 95)
    return tracks.current[on_the_road] - moved(tracks.previous[on_the_road])


def test_corners_on_the_road_are_tracked_through_the_predicted_flow(road_frames):
    """Also with a length that is wrong by a tenth, as learned depth is."""
    plain = errors(CornerTracker().track(*road_frames))
    predicted = errors(CornerTracker().track(*road_frames, predicted_flow(0.9 * LENGTH)))
    right_plain, right_predicted = (
        (np.abs(each).max(axis=1) < 0.3).sum() for each in (plain, predicted)
    )
    assert right_predicted > max(2 * right_plain, 25)
    assert abs(np.median(predicted[:, 1])) < 0.15


def test_a_wrong_prediction_moves_corners_by_fractions_of_a_pixel(road_frames):
    """Of a standing camera whose flow is predicted as if it went on at full speed, by some ten pixels near the car."""
    still = [road_frames[0], Frame(1, 0.1, road_frames[0].image)]
    tracks = CornerTracker().track(*still, predicted_flow())
    assert len(tracks.track_ids) > 100
    median, most = np.quantile(np.abs(tracks.current - tracks.previous).max(axis=1), [0.5, 0.9])
    assert median < 0.15 and most < 0.7
