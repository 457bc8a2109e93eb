"""Pose of one camera from known points: robust Gauss-Newton from guesses, consensus where they disagree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.frames import Intrinsics
from slam.frontend.keyframes.bundle_adjustment import Noise
from slam.geometry.projection import LEAST_DEPTH, pixel_jacobian
from slam.geometry.resection import consensus
from slam.geometry.robust import mad_sigma, median
from slam.geometry.se3 import FloatArray, apply, compose, make, rotation_matrix

MIN_POINTS = 20  # least number of points that give a camera its pose
INLIER_PX = 3.0  # residual of an inlier of a camera's pose, pixels
_ITERATIONS = 12
# radians, and units of the map: hundredths of a pixel
_CONVERGED = 5e-5
_LEAST_PIXEL_SIGMA = 0.1
# below this inlier ratio the pose may be one that some wrong tracks agree on
_DOUBTFUL_RATIO = 0.75
_CLEARLY = 2.0  # times the support of the pose by all points, of that by trusted ones in its place
_SAMPLES = 300
_PIXEL_SIGMA = Noise().pixel  # of a sighting


@dataclass(frozen=True)
class CameraPose:
    """``T_camera_world``, ``residual_px`` ``(M,)`` without what uncertain depth explains, and ``sigmas`` ``(6,)``.

    Behind the camera the residual is infinite. The sigmas are of a perturbation on the left, rotation first, for
    independent errors.
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
    trusted: NDArray[np.bool_] | None = None,
) -> CameraPose:
    """The pose found from the first guess ``T_camera_world``; in doubt that with most inliers, from others too.

    Two guesses matter: from the prediction by the last motion alone, a wrong pose predicts the next wrong pose.

    Args:
        guesses: start poses, at least one; if few points fit by the first, the next ones and consensus are tried.
        points: in the world ``(M, 3)``, at least 6.
        pixels: of the points ``(M, 2)``.
        intrinsics: of the camera.
        seed: of RANSAC.
        spread: one sigma of each point ``(M, 3)``, in the direction in which it is uncertain; None for exact points.
        trusted: points ``(M,)`` that fitted the last image; where most of them contradict the pose by all points, and
            have one of their own, something passes before the camera, and theirs is taken.
    """
    everything = np.ones(len(points), np.bool_)
    best = _best(guesses, points, pixels, intrinsics, seed, spread, everything)
    if trusted is not None and _support(best, trusted) < _DOUBTFUL_RATIO * trusted.sum():
        by_trusted = _best(guesses, points, pixels, intrinsics, seed, spread, trusted)
        best = by_trusted if _support(by_trusted, trusted) > _CLEARLY * _support(best, trusted) else best
    return best


def _support(pose: CameraPose, votes: NDArray[np.bool_]) -> int:
    return int((pose.residual_px[votes] < INLIER_PX).sum())


def _best(
    guesses: Sequence[FloatArray],
    points: FloatArray,
    pixels: FloatArray,
    intrinsics: Intrinsics,
    seed: int,
    spread: FloatArray | None,
    votes: NDArray[np.bool_],
) -> CameraPose:
    """The pose by the points that vote ``(M,)``."""

    def is_sure(pose: CameraPose) -> bool:
        return bool(_support(pose, votes) >= _DOUBTFUL_RATIO * votes.sum())

    best = _refined(guesses[0], points, spread, pixels, intrinsics, votes)
    for guess in guesses[1:]:
        if is_sure(best):
            break
        other = _refined(guess, points, spread, pixels, intrinsics, votes)
        best = max(best, other, key=lambda pose: _support(pose, votes))
    if not is_sure(best):
        found = consensus(points[votes], pixels[votes], intrinsics.K, _SAMPLES, INLIER_PX, seed)
        if found is not None:
            start = make(rotation_matrix(found[0]), found[1])
            other = _refined(start, points, spread, pixels, intrinsics, votes)
            best = max(best, other, key=lambda pose: _support(pose, votes))
    return best


def _refined(
    T_camera_world: FloatArray,
    points: FloatArray,
    spread: FloatArray | None,
    pixels: FloatArray,
    intrinsics: Intrinsics,
    votes: NDArray[np.bool_],
) -> CameraPose:
    """Cauchy weights of half an inlier; far from the solution, where all residuals are large, of their median."""
    T = T_camera_world.copy()
    focal = np.array([intrinsics.fx, intrinsics.fy])
    rays = intrinsics.rays(pixels)[:, :2]
    residual, J, X = _whitened(T, points, spread, rays, focal)
    for _ in range(_ITERATIONS):
        norm = np.hypot(*residual)
        scale = max(0.5 * INLIER_PX, median(norm[votes]))
        weight = np.where(votes & (X[:, 2] > LEAST_DEPTH), 1.0 / (1.0 + (norm / scale) ** 2), 0.0)
        weighted = (weight * J).reshape(6, -1)
        information = weighted @ J.reshape(6, -1).T + 1e-9 * np.eye(6)
        step = np.asarray(np.linalg.solve(information, -weighted @ residual.ravel()), np.float64)
        T = compose(make(rotation_matrix(step[:3]), step[3:]), T)
        residual, J, X = _whitened(T, points, spread, rays, focal)
        if np.abs(step).max() < _CONVERGED:
            break
    in_front = X[:, 2] > LEAST_DEPTH
    sigma = max(mad_sigma(residual[:, votes]), _LEAST_PIXEL_SIGMA)
    sigmas = sigma * np.sqrt(np.diag(np.linalg.inv(information)))
    return CameraPose(T, np.where(in_front, np.hypot(*residual), np.inf), sigmas)


def _whitened(
    T_camera_world: FloatArray, points: FloatArray, spread: FloatArray | None, rays: FloatArray, focal: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals of pixels ``(2, M)``, their derivatives ``(6, 2, M)``, and the points in the camera ``(M, 3)``.

    Along the line on which the sigma of a point moves its pixel, both are divided by as much as it adds to the noise.
    """
    X = apply(T_camera_world, points)
    z = np.maximum(X[:, 2], LEAST_DEPTH)
    residual, J = ((X[:, :2] / z[:, None] - rays) * focal).T, pixel_jacobian(X, focal)
    if spread is None:
        return residual, J, X
    line = (J[3:] * (spread @ T_camera_world[:3, :3].T).T[:, None]).sum(axis=0)
    square = np.maximum((line**2).sum(axis=0), 1e-9)
    taken = (1.0 - _PIXEL_SIGMA / np.sqrt(_PIXEL_SIGMA**2 + square)) / square
    residual, J = (each - (taken * (each * line).sum(axis=-2))[..., None, :] * line for each in (residual, J))
    return residual, J, X
