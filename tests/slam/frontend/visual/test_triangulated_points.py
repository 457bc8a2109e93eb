from __future__ import annotations

import numpy as np
import pytest

from slam.frontend.visual.step_check import TriangulatedPoints


def triangulated(track_ids: np.ndarray, previous: np.ndarray, current: np.ndarray) -> TriangulatedPoints:
    return TriangulatedPoints(track_ids, previous, current, np.full(len(track_ids), 0.02))


def test_ratio_of_lengths_from_common_points() -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(4.0, 20.0, 60)  # metres, in the camera between
    track_ids = np.arange(60)
    earlier = triangulated(track_ids, depth + 2.0, depth / 2.0)  # a step of 2 m
    wrong = np.where(track_ids < 10, 3.0, 1.0)
    later = triangulated(track_ids[::-1] + 5, depth[::-1] / 1.5, depth[::-1])
    assert triangulated(track_ids + 100, depth, depth).length_ratio(earlier) is None
    shifted = triangulated(track_ids, wrong * depth / 1.5, depth)  # a step of 1.5 m, ten points on a car
    ratio = shifted.length_ratio(earlier)
    assert ratio is not None
    assert ratio[0] == pytest.approx(np.log(1.5 / 2.0), abs=1e-9)
    again = later.length_ratio(triangulated(track_ids + 5, depth + 2.0, depth / 2.0))
    assert again is not None and again[0] == pytest.approx(np.log(1.5 / 2.0), abs=1e-9)
