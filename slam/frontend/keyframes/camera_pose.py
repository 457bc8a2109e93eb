"""Pose of one camera from known points: robust Gauss-Newton from guesses, consensus where they disagree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slam.frames import Intrinsics
from slam.geometry.projection import LEAST_DEPTH, pixel_jacobian
from slam.geometry.resection import consensus
from slam.geometry.robust import mad_sigma
from slam.geometry.se3 import FloatArray, apply, from_rotation_vector, make

MIN_POINTS = 20  # least number of points that give a camera its pose
INLIER_PX = 3.0  # residual of an inlier of a camera's pose, pixels
_ITERATIONS = 12
# radians, and units of the map: hundredths of a pixel
_CONVERGED = 1e-5
_LEAST_PIXEL_SIGMA = 0.1
# below this inlier ratio the pose may be one that some wrong tracks agree on
_DOUBTFUL_RATIO = 0.75
_SAMPLES = 300
_PIXEL_SIGMA = 0.7  # of a sighting


@dataclass(frozen=True)
class CameraPose:
    """``T_camera_world``, ``residual_px`` ``(M,)``, infinite behind the camera, without what uncertain depth explains, and ``sigmas`` ``(6,)``.

    The sigmas are of a perturbation on the left, rotation first, for known points and independent errors.
    """

    T_camera_world: FloatArray
    residual_px: FloatArray
    sigmas: FloatArray


def resect(
    guesses: Sequence[FloatArray],
    points: FloatArray,
    pixels: FloatArray,
    intrinsics: Intrinsics,
    seed: int = 0,
    spread: FloatArray | None = None,
) -> CameraPose:
    """The pose found from the first guess ``T_camera_world``; in doubt that with most inliers, from others too.

    Two guesses matter: from the prediction by the last motion alone, a wrong pose predicts the next wrong pose.

    Args:
        guesses: start poses, at least one; if few points fit by the first, the next ones and consensus are tried.
        points: in the world ``(M, 3)``, at least 6.
        pixels: of the points ``(M, 2)``.
        intrinsics: of the camera.
        seed: of RANSAC.
        spread: one sigma of each point ``(M, 3)``, along the ray on which its depth is uncertain; None if all are exact.
    """
    spread = np.zeros_like(points) if spread is None else spread

    def support(pose: CameraPose) -> int:
        return int((pose.residual_px < INLIER_PX).sum())

    best = _refined(guesses[0], points, spread, pixels, intrinsics)
    for guess in guesses[1:]:
        if support(best) >= _DOUBTFUL_RATIO * len(points):
            break
        best = max(best, _refined(guess, points, spread, pixels, intrinsics), key=support)
    if support(best) < _DOUBTFUL_RATIO * len(points):
        found = consensus(points, pixels, intrinsics.K, _SAMPLES, INLIER_PX, seed)
        if found is not None:
            start = make(cv2.Rodrigues(found[0])[0], found[1])
            best = max(best, _refined(start, points, spread, pixels, intrinsics), key=support)
    return best


def _refined(
    T_camera_world: FloatArray, points: FloatArray, spread: FloatArray, pixels: FloatArray, intrinsics: Intrinsics
) -> CameraPose:
    """Cauchy weights of half an inlier; far from the solution, where all residuals are large, of their median."""
    T = T_camera_world.copy()
    focal = np.array([intrinsics.fx, intrinsics.fy])
    rays = intrinsics.rays(pixels)[:, :2]
    residual, X = _residual(T, points, rays, focal)
    J = pixel_jacobian(X, focal)
    whitened = _Whitening.of(J, T, spread)
    residual = whitened(residual)
    for _ in range(_ITERATIONS):
        norm = np.hypot(*residual)
        scale = max(0.5 * INLIER_PX, float(np.median(norm)))
        weight = np.where(X[:, 2] > LEAST_DEPTH, 1.0 / (1.0 + (norm / scale) ** 2), 0.0)
        J = whitened(J)
        weighted = (weight * J).reshape(6, -1)
        information = weighted @ J.reshape(6, -1).T + 1e-9 * np.eye(6)
        step = np.asarray(np.linalg.solve(information, -weighted @ residual.ravel()), np.float64)
        T = from_rotation_vector(step[:3], step[3:]) @ T
        residual, X = _residual(T, points, rays, focal)
        J = pixel_jacobian(X, focal)
        whitened = _Whitening.of(J, T, spread)
        residual = whitened(residual)
        if np.abs(step).max() < _CONVERGED:
            break
    in_front = X[:, 2] > LEAST_DEPTH
    sigma = max(mad_sigma(residual), _LEAST_PIXEL_SIGMA)
    sigmas = sigma * np.sqrt(np.diag(np.linalg.inv(information)))
    return CameraPose(T, np.where(in_front, np.hypot(*residual), np.inf), sigmas)


@dataclass(frozen=True)
class _Whitening:
    """Of pixels: along ``direction`` ``(2, M)`` those of uncertain points count less, by ``less`` ``(M,)``."""

    direction: FloatArray
    less: FloatArray

    @classmethod
    def of(cls, J: FloatArray, T_camera_world: FloatArray, spread: FloatArray) -> _Whitening:
        direction = np.einsum("ism,im->sm", J[3:], T_camera_world[:3, :3] @ spread.T)
        square = np.maximum((direction**2).sum(axis=0), 1e-9)
        return cls(direction, (1.0 - _PIXEL_SIGMA / np.sqrt(_PIXEL_SIGMA**2 + square)) / square)

    def __call__(self, pixels: FloatArray) -> FloatArray:
        """Pixels ``(..., 2, M)`` in pixels of equal certainty."""
        along = self.less * (pixels * self.direction).sum(axis=-2)
        return np.asarray(pixels - along[..., None, :] * self.direction)


def _residual(
    T_camera_world: FloatArray, points: FloatArray, rays: FloatArray, focal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Of both pixel coordinates ``(2, M)``, and the points in the camera ``(M, 3)``."""
    X = apply(T_camera_world, points)
    z = np.maximum(X[:, 2], LEAST_DEPTH)
    return ((X[:, :2] / z[:, None] - rays) * focal).T, X
