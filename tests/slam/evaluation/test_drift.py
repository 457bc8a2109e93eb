"""Drift of trajectories has its value by hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from slam.evaluation.trajectory import FIGURE_LENGTHS_M, aligned, segment_errors
from slam.formats.trajectory import Trajectory
from slam.geometry.se3 import Similarity, from_rotation_vector
from slam.results.folder import RunFolder


def moved(trajectory: Trajectory, scale: float) -> Trajectory:
    """The same motion in another world and unit."""
    T_other_world = from_rotation_vector(np.array([0.3, -0.5, 0.2]), np.array([4.0, 5.0, 6.0]))
    similarity = Similarity(scale, T_other_world[:3, :3], T_other_world[:3, 3])
    return Trajectory(trajectory.stamps, similarity.apply_to_poses(trajectory.T_world_camera))


def test_alignment_removes_a_similarity_and_drift_is_then_zero(make_run: Callable[..., RunFolder]) -> None:
    reference = make_run().trajectory("reference")
    assert reference is not None
    fitted = aligned({"reference": reference, "optimised": moved(reference, 0.2)})["optimised"]
    np.testing.assert_allclose(fitted.positions, reference.positions, atol=1e-5)
    segments = segment_errors(fitted.T_world_camera, reference.T_world_camera, FIGURE_LENGTHS_M)
    assert [each.length_m for each in segments] == [10.0, 20.0, 50.0, 100.0, 200.0]
    assert max(each.translation_m.max() for each in segments) < 1e-4
    assert max(each.rotation.max() for each in segments) < 1e-4


def test_drift_of_a_known_scale_and_rotation_has_its_hand_value() -> None:
    frames = 121
    T_true = np.tile(np.eye(4), (frames, 1, 1))
    T_true[:, 2, 3] = np.arange(frames)
    T_estimate = T_true.copy()
    T_estimate[:, 2, 3] *= 1.05
    (segments,) = segment_errors(T_estimate, T_true, [10.0])
    # a segment ends with the first frame beyond its length, KITTI's rule: 11 m for 10 m
    assert segments.translation_m == pytest.approx(0.05 * 11)
    assert (segments.rotation == 0.0).all()
