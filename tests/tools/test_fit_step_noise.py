"""Ratios are found again from errors that were drawn by them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from slam.evaluation.coverage import LEVELS
from slam.frontend.network_factors import STUDENT_T_DOF

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

import fit_step_noise as tool

STEPS = 3000


def drawn(ratios: np.ndarray, seed: int) -> tool.DriveSteps:
    """Errors by Student's t with the variances of these ratios."""
    rng = np.random.default_rng(seed)
    corners = np.full((STEPS, 6), 1e-8)
    parts = np.zeros((len(ratios), STEPS, 6))
    for k, rows in enumerate((slice(0, 3), slice(3, 6), slice(0, 3), slice(0, 3), slice(3, 6))):
        parts[k, k % 4 :: 4, rows] = 1e-6  # each part widens other steps, so that all are determined
    sigmas = np.sqrt(corners + np.tensordot(ratios**2, parts, axes=1))
    tails = np.sqrt((STUDENT_T_DOF - 2) / rng.chisquare(STUDENT_T_DOF, (STEPS, 1)))
    return tool.DriveSteps("drawn", rng.normal(size=(STEPS, 6)) * sigmas * tails, corners, parts)


def test_the_ratios_of_the_errors_are_found_and_their_bounds_hold() -> None:
    ratios = np.array([0.6, 5.0, 0.3, 0.4, 2.0])
    drives = [drawn(ratios, seed) for seed in (1, 2)]
    found = tool.fit(drives)
    np.testing.assert_allclose(found, ratios, rtol=0.15)
    held_out = drawn(ratios, 3)
    np.testing.assert_allclose(held_out.coverage(found), np.array(LEVELS) / 100, atol=0.03)
    assert max(held_out.coverage(found / 3)) < 0.6


@pytest.mark.data
def test_a_drive_without_true_poses_is_refused(data_root: Path) -> None:
    with pytest.raises(SystemExit, match="has no true poses"):
        tool.main([str(data_root / "folders" / "kitti_video_b"), "--weights", "sim"])
