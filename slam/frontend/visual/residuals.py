"""Residuals of corners under a motion, across and along their epipolar lines, with their derivatives."""

from __future__ import annotations

import math

import numpy as np

from slam.geometry.epipolar import UnitRelativePose, cross
from slam.geometry.se3 import FloatArray

# hat(w) row by row, by each component of w
_HATS = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]], float)


class Residuals:
    """Residuals of ``M`` corners in two images, in pixels.

    Derivatives ``(5, M)`` are by rotation, in the current camera, and by the direction along both axes of its
    ``tangent`` ``(3, 2)``; a sixth is by the length. Arrays are coordinate-major, which is several times faster.
    """

    def __init__(
        self, rays_previous: FloatArray, rays_current: FloatArray, depth_previous: FloatArray, focal_px: float
    ) -> None:
        """From rays ``(M, 3)`` with z = 1, and learned depths ``(M,)`` in the earlier camera or NaN."""
        self._previous = np.ascontiguousarray(rays_previous.T)
        self._current = np.ascontiguousarray(rays_current.T)
        # every bilinear form of the rays is a matrix times one of these
        self._both = _products(self._current, self._previous)
        self._previous_twice = _products(self._previous, self._previous)
        self._current_twice = _products(self._current, self._current)
        self._inverse_depth = np.where(np.isfinite(depth_previous), 1.0 / depth_previous, 0.0)
        self._focal_px = focal_px

    def across(self, unit_pose: UnitRelativePose, tangent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sampson distances ``(M,)`` and their derivatives ``(5, M)`` (Hartley and Zisserman 2004, Eq. 11.9).

        The gradient's norm changes with the motion too. Held fixed, as reweighted least squares do, it biases the
        motion by the square of the corners' noise.
        """
        essential = _essential(unit_pose, tangent)
        algebraic = essential.reshape(6, 9) @ self._both
        # squared lengths of E x and E^T x' without their last coefficients, and half their derivatives
        lines_current = essential[:, :2].swapaxes(1, 2) @ essential[0, :2]
        lines_previous = essential[:, :, :2] @ essential[0, :, :2].T
        squares = lines_current.reshape(6, 9) @ self._previous_twice
        squares += lines_previous.reshape(6, 9) @ self._current_twice
        gradient = np.sqrt(np.maximum(squares[0], 1e-18))
        distance = algebraic[0] / gradient
        slopes = (algebraic[1:] - distance / gradient * squares[1:]) / gradient
        return distance * self._focal_px, slopes * self._focal_px

    def along(
        self, unit_pose: UnitRelativePose, length: float, tangent: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Distances ``(M,)`` along the epipolar lines from the points predicted by learned depth.

        Also their derivatives ``(6, M)``, and the shift along the line predicted by learned depth ``(M,)``.
        """
        rotated = unit_pose.R_current_previous @ self._previous
        points = rotated + (length * unit_pose.direction)[:, None] * self._inverse_depth  # over depth
        ahead = np.maximum(points[2], 1e-6)
        expected = points[:2] / ahead
        line = expected - rotated[:2] / np.maximum(rotated[2], 1e-6)
        shift = np.sqrt((line**2).sum(axis=0))
        line /= np.maximum(shift, 1e-9)
        distance = ((expected - self._current[:2]) * line).sum(axis=0)
        by_point = np.concatenate([line, -(line * expected).sum(axis=0)[None]]) / ahead
        slopes = np.empty((6, len(distance)))
        slopes[:3] = cross(rotated, by_point)
        slopes[3:5] = tangent.T @ by_point * (length * self._inverse_depth)
        slopes[5] = unit_pose.direction @ by_point * self._inverse_depth
        return distance * self._focal_px, slopes * self._focal_px, shift * self._focal_px


def _products(a: FloatArray, b: FloatArray) -> FloatArray:
    """Outer products ``(9, M)`` of vectors ``(3, M)``."""
    return (a[:, None] * b).reshape(9, -1)


def tangent_of(direction: FloatArray) -> FloatArray:
    """Two unit axes ``(3, 2)`` orthogonal to a ``direction`` ``(3,)`` and each other (Duff et al. 2017)."""
    x, y, z = direction.tolist()
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[1.0 + sign * x * x * a, b], [sign * b, sign + y * y * a], [-sign * x, -y]])


def _essential(unit_pose: UnitRelativePose, tangent: FloatArray) -> FloatArray:
    """``E = hat(t) R`` and its five derivatives, ``(6, 3, 3)``."""
    essential = np.empty((6, 3, 3))
    essential[0] = across = (unit_pose.direction @ _HATS).reshape(3, 3)
    essential[1:4] = across @ _HATS.reshape(3, 3, 3)
    essential[4:] = (tangent.T @ _HATS).reshape(2, 3, 3)
    return np.asarray(essential @ unit_pose.R_current_previous)
