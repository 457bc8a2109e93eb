"""Whether factors err as far as they say: the share of them within their own bounds, at the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2, f

from slam.errors import SlamError
from slam.frames import RelativePose
from slam.pose_graph import whitened_squared
from slam.se3 import FloatArray

LEVELS = (50, 90, 95)


def coverage(relative_poses: Sequence[RelativePose], T_world_camera_true: FloatArray, scale: float) -> dict[str, float]:
    """Share of factors whose error lies within what 50, 90 and 95 % of all errors of their stated noise do.

    Args:
        relative_poses: measurements with their noise, at least one.
        T_world_camera_true: truth ``(N, 4, 4)``, metres.
        scale: units of the measurements per metre; brings the truth to their scale.

    Raises:
        SlamError: if there is no measurement or the scale is not positive.
    """
    if not relative_poses or not scale > 0:
        raise SlamError(f"coverage needs factors and a positive scale; got {len(relative_poses)} and {scale}")
    T_world_camera = T_world_camera_true.copy()
    T_world_camera[:, :3, 3] *= scale
    squared = whitened_squared(relative_poses, T_world_camera)
    laws, law = np.unique([edge.student_t_dof for edge in relative_poses], return_inverse=True)
    bounds = {
        level: np.array([squared_bound(level / 100, student_t_dof) for student_t_dof in laws])[law] for level in LEVELS
    }
    return {str(level): float((squared <= bound).mean()) for level, bound in bounds.items()}


def squared_bound(share: float, student_t_dof: float) -> float:
    """Whitened squared error of six numbers that this share of all errors stays within.

    For errors by Student's t with ``student_t_dof`` degrees of freedom, whose standard deviations are the sigmas: a
    quantile of Fisher's F. For normal errors (infinite ``student_t_dof``): a quantile of chi-square.
    """
    if math.isinf(student_t_dof):
        return float(chi2.ppf(share, 6))
    return float(6 * (student_t_dof - 2) / student_t_dof * f.ppf(share, 6, student_t_dof))


def coverage_by_source(
    relative_poses: Sequence[RelativePose], T_world_camera_true: FloatArray, scale: float
) -> dict[str, dict[str, float]]:
    """Number of factors and `coverage` of each kind of measurement, by the name of its source."""
    kinds: dict[str, list[RelativePose]] = {}
    for edge in relative_poses:
        kinds.setdefault(edge.source, []).append(edge)
    return {
        source: {"factors": len(edges), **coverage(edges, T_world_camera_true, scale)}
        for source, edges in sorted(kinds.items())
    }
