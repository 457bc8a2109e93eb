"""Coverage: the ratio of factors whose error at the true poses lies inside the bounds of their stated noise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri, fdtri

from slam.frames import RelativePose
from slam.geometry.se3 import FloatArray
from slam.graph.pose_graph import whitened_squared

LEVELS = (50, 90, 95)


def coverage(
    relative_poses: Sequence[RelativePose], T_world_camera_true: FloatArray, scale: float
) -> dict[str, dict[str, float]]:
    """Ratio of factors whose error lies inside the 50, 90 and 95 % bound of their stated noise, ``{"50": 0.49, ...}``.

    Under ``""`` of all of them, and by source, there with their number under ``factors``.

    Args:
        relative_poses: measurements with their noise, at least one.
        T_world_camera_true: truth ``(N, 4, 4)``, metres.
        scale: units of the measurements per metre, positive; scales the truth to them.
    """
    T_world_camera = T_world_camera_true.copy()
    T_world_camera[:, :3, 3] *= scale
    squared = whitened_squared(relative_poses, T_world_camera)
    dofs, dof_of_factor = np.unique([edge.student_t_dof for edge in relative_poses], return_inverse=True)
    inside = {}
    for level in LEVELS:
        bounds = np.array([squared_bound(level / 100, dof) for dof in dofs])
        inside[str(level)] = squared <= bounds[dof_of_factor]  # (F,)
    sources = np.array([edge.source for edge in relative_poses])
    found = {"": {level: float(within.mean()) for level, within in inside.items()}}
    for source in np.unique(sources):
        ratios = {level: float(within[sources == source].mean()) for level, within in inside.items()}
        found[str(source)] = {"factors": int((sources == source).sum()), **ratios}
    return found


def squared_bound(probability: float, student_t_dof: float) -> float:
    """Quantile of the whitened squared error of six numbers.

    For errors by Student's t with ``student_t_dof`` degrees of freedom, whose standard deviations are the sigmas: a
    quantile of Fisher's F. For normal errors (infinite ``student_t_dof``): a quantile of chi-square.
    """
    if math.isinf(student_t_dof):
        return float(chdtri(6, 1.0 - probability))
    return float(6 * (student_t_dof - 2) / student_t_dof * fdtri(6, student_t_dof, probability))
