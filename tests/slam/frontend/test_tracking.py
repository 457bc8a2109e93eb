"""Corners tracked through drawn images that slide by whole pixels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slam.frames import Frame, Intrinsics
from slam.frontend.tracking import CornerTracker
from slam.frontend.visual.predicted_flow import PredictedFlow
from slam.geometry.epipolar import UnitRelativePose

SHIFT_PX = 4


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """A wide image that slides to the left by whole pixels."""
    noise = np.random.default_rng(0).integers(0, 255, (120, 300), np.uint8)
    wide = np.repeat(cv2.GaussianBlur(noise, (0, 0), 1.5)[..., None], 3, axis=2)
    return [Frame(k, 0.1 * k, np.ascontiguousarray(wide[:, SHIFT_PX * k :][:, :200])) for k in range(6)]


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
    camera = Intrinsics(200, 120, 100.0, 100.0, 100.0, 60.0)
    depth, sliding = np.full((120, 200), 10.0, np.float32), UnitRelativePose(np.eye(3), np.array([-1.0, 0.0, 0.0]))
    predicted = PredictedFlow(sliding, 2 * SHIFT_PX * 10.0 / 100.0 + 0.05, depth, camera)  # half a pixel too far
    across = tracker.track_across(frames[0], frames[2], predicted)()
    assert len(across.track_ids) > 0.8 * len(tracks[0].track_ids)
    assert np.isin(across.track_ids, tracks[0].track_ids).all()
    error = np.abs(across.previous - across.current - [2 * SHIFT_PX, 0]).max(axis=1)
    assert np.median(error) < 0.02 and error.max() < 0.5


def test_lost_corners_are_not_tracked_across(frames):
    camera = Intrinsics(200, 120, 100.0, 100.0, 100.0, 60.0)
    nothing = PredictedFlow(
        UnitRelativePose(np.eye(3), np.array([0.0, 0.0, -1.0])), 0.0, np.ones((120, 200), np.float32), camera
    )
    assert len(CornerTracker().track_across(frames[0], frames[2], nothing)().track_ids) == 0
