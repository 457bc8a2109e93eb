"""Points from their sightings by several cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray


def triangulate(
    T_camera_world: FloatArray, rays: FloatArray, point: NDArray[np.int64], count: int
) -> tuple[FloatArray, FloatArray]:
    """Points ``(count, 3)`` closest to all their rays, and the widest angle between two of each point's rays, radians.

    Least squares of the distances to the rays: ``sum (I - d d^T) (X - c) = 0``. NaN where rays are parallel.

    Args:
        T_camera_world: of each sighting ``(S, 4, 4)``.
        rays: of each sighting in its camera ``(S, 3)``.
        point: of each sighting ``(S,)``.
        count: points.
    """
    R = T_camera_world[:, :3, :3]
    centres = -np.einsum("sji,sj->si", R, T_camera_world[:, :3, 3])
    directions = np.einsum("sji,sj->si", R, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    A, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(A, point, across)
    np.add.at(b, point, np.einsum("sij,sj->si", across, centres))
    usable = np.linalg.det(A) > 1e-12
    X = np.full((count, 3), np.nan)
    X[usable] = np.linalg.solve(A[usable], b[usable][:, :, None])[:, :, 0]
    # against the first ray of each point: the widest angle within a factor of two, and in one pass
    first = np.full(count, -1)
    first[point[::-1]] = np.arange(len(point))[::-1]
    cosine = (directions * directions[first[point]]).sum(axis=1)
    angle = np.zeros(count)
    np.maximum.at(angle, point, np.arccos(np.clip(cosine, -1.0, 1.0)))
    return X, angle


def reprojection_errors(
    T_camera_world: FloatArray, points: FloatArray, rays: FloatArray, focal: tuple[float, float]
) -> FloatArray:
    """Distances in pixels ``(S,)`` between sightings and their points; infinite behind a camera.

    Args:
        T_camera_world: of each sighting ``(S, 4, 4)``.
        points: of each sighting ``(S, 3)``.
        rays: of each sighting in its camera ``(S, 3)``, z = 1.
        focal: lengths along both axes, pixels.
    """
    X = np.einsum("sij,sj->si", T_camera_world[:, :3, :3], points) + T_camera_world[:, :3, 3]
    in_front = X[:, 2] > 0
    offset = (X[:, :2] / np.where(in_front, X[:, 2], 1.0)[:, None] - rays[:, :2]) * focal
    return np.where(in_front, np.linalg.norm(offset, axis=1), np.inf)
