"""Projection by a pinhole camera that is perturbed on the left, ``Exp(xi) T_camera_world``, rotation first."""

from __future__ import annotations

import numpy as np

from slam.se3 import FloatArray

LEAST_DEPTH = 1e-6


def pixel_jacobian(X: FloatArray, focal: FloatArray) -> FloatArray:
    """Derivatives ``(M, 2, 6)`` of pixels by the camera's perturbation, at points ``(M, 3)`` in the camera."""
    x, y, z = X[:, 0], X[:, 1], np.maximum(X[:, 2], LEAST_DEPTH)
    by_place = np.zeros((len(X), 2, 3))
    by_place[:, 0, 0], by_place[:, 0, 2] = focal[0] / z, -focal[0] * x / z**2
    by_place[:, 1, 1], by_place[:, 1, 2] = focal[1] / z, -focal[1] * y / z**2
    by_rotation = np.cross(X[:, None, :], by_place)  # a row j of by_place gives j (w x X) = w (X x j)
    return np.concatenate([by_rotation, by_place], axis=2)
