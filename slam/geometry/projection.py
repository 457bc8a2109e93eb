"""Projection by a pinhole camera that is perturbed on the left, ``Exp(xi) T_camera_world``, rotation first."""

from __future__ import annotations

import numpy as np

from slam.geometry.se3 import FloatArray

LEAST_DEPTH = 1e-6


def pixel_jacobian(X: FloatArray, focal: FloatArray) -> FloatArray:
    """Derivatives ``(6, 2, M)`` of pixels by the camera's perturbation, at points ``(M, 3)`` in the camera."""
    x, y, inverse = X[:, 0], X[:, 1], 1.0 / np.maximum(X[:, 2], LEAST_DEPTH)
    u, v = x * inverse, y * inverse
    J = np.zeros((6, 2, len(X)))  # points last: arithmetic on long rows
    J[0, 0], J[1, 0], J[2, 0], J[3, 0], J[5, 0] = -u * v, 1.0 + u * u, -v, inverse, -u * inverse
    J[0, 1], J[1, 1], J[2, 1], J[4, 1], J[5, 1] = -1.0 - v * v, u * v, u, inverse, -v * inverse
    J *= focal[:, None]
    return J
