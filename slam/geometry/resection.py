"""Perspective-n-point: the pose of one camera by known points, robustly from guesses, by consensus where they disagree.

A camera is perturbed on the left, ``Exp(xi) T_camera_world``, rotation first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.geometry.robust import mad_sigma, median
from slam.geometry.se3 import FloatArray, apply, compose, make, rotation_matrix

LEAST_DEPTH = 1e-6
MIN_POINTS = 20  # least number of points that give a camera its pose
INLIER_PX = 3.0  # residual of an inlier of a camera's pose, pixels
_ITERATIONS = 12
# radians, and units of the map: hundredths of a pixel
_CONVERGED = 5e-5
_LEAST_PIXEL_SIGMA = 0.1
_DAMPING = 1e-13  # of the trace: points hardly in front of the camera leave a matrix that is singular in doubles
# below this inlier ratio the pose may be one that some wrong tracks agree on
_DOUBTFUL_RATIO = 0.75
_CLEARLY = 2.0  # times the support of the pose by all points, of that by trusted ones in its place
_SAMPLES = 300
PIXEL_SIGMA = 0.7  # of a coordinate of a sighting, pixels
_CONFIDENCE = 0.999


@dataclass(frozen=True)
class Resection:
    """``T_camera_world``, ``residual_px`` ``(M,)`` without what uncertain depth explains, and ``sigmas`` ``(6,)``.

    Behind the camera the residual is infinite. The sigmas are of a perturbation on the left, rotation first, for
    independent errors.
    """

    T_camera_world: FloatArray
    residual_px: FloatArray
    sigmas: FloatArray

    @property
    def inliers(self) -> NDArray[np.intp]:
        """Rows of the points that fit."""
        return np.flatnonzero(self.residual_px < INLIER_PX)


def ransac_order(count: int, seed: int) -> NDArray[np.intp]:
    """The order ``(count,)`` of the points for a RANSAC method of OpenCV's, whose seed is fixed; 0 is the given one."""
    order = np.arange(count, dtype=np.intp)
    return order if seed == 0 else np.random.default_rng(seed).permutation(order)


def consensus(
    points: FloatArray, pixels: FloatArray, K: FloatArray, iterations: int, reprojection_px: float, seed: int = 0
) -> tuple[FloatArray, NDArray[np.intp]] | None:
    """``T_camera_world`` and rows of the inliers with most support, or None.

    Samples of three points (OpenCV's USAC, without its local optimisation, which `resect` makes needless).

    Args:
        points: ``(M, 3)``.
        pixels: their projections ``(M, 2)``, in the unit of K.
        K: camera matrix ``(3, 3)``; the identity for rays.
        iterations: RANSAC samples.
        reprojection_px: largest reprojection error of an inlier.
        seed: other seeds draw other samples.
    """
    order = ransac_order(len(points), seed)
    params = cv2.UsacParams()
    params.maxIterations, params.threshold, params.confidence = iterations, reprojection_px, _CONFIDENCE
    params.sampler, params.score = cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_NULL
    is_solved, _, rotation, translation, chosen = cv2.solvePnPRansac(
        points[order], pixels[order], K.copy(), None, params=params
    )
    if not is_solved or chosen is None:
        return None
    return make(rotation_matrix(rotation.ravel()), translation.ravel()), order[chosen.ravel()]


def resect(
    guesses: Sequence[FloatArray],
    points: FloatArray,
    pixels: FloatArray,
    K: FloatArray,
    seed: int = 0,
    spread: FloatArray | None = None,
    trusted: NDArray[np.bool_] | None = None,
) -> Resection:
    """The pose found from the first guess ``T_camera_world``; in doubt that with most inliers, from others too.

    Two guesses matter: from the prediction by the last motion alone, a wrong pose predicts the next wrong pose.

    Args:
        guesses: start poses, at least one; if few points fit by the first, the next ones and consensus are tried.
        points: in the world ``(M, 3)``, at least 6.
        pixels: of the points ``(M, 2)``.
        K: camera matrix ``(3, 3)``.
        seed: of RANSAC.
        spread: one sigma of each point ``(M, 3)``, in the direction in which it is uncertain; None for exact points.
        trusted: points ``(M,)`` that fitted the last image; where most of them contradict the pose by all points, and
            have one of their own, something passes before the camera, and theirs is taken.
    """
    everything = np.ones(len(points), np.bool_)
    best = _best(guesses, points, pixels, K, seed, spread, everything)
    if trusted is not None and _support(best, trusted) < _DOUBTFUL_RATIO * trusted.sum():
        by_trusted = _best(guesses, points, pixels, K, seed, spread, trusted)
        best = by_trusted if _support(by_trusted, trusted) > _CLEARLY * _support(best, trusted) else best
    return best


def _support(pose: Resection, votes: NDArray[np.bool_]) -> int:
    return int((pose.residual_px[votes] < INLIER_PX).sum())


def _best(
    guesses: Sequence[FloatArray],
    points: FloatArray,
    pixels: FloatArray,
    K: FloatArray,
    seed: int,
    spread: FloatArray | None,
    votes: NDArray[np.bool_],
) -> Resection:
    """The pose by the points that vote ``(M,)``."""

    def is_sure(pose: Resection) -> bool:
        return bool(_support(pose, votes) >= _DOUBTFUL_RATIO * votes.sum())

    best = _refined(guesses[0], points, spread, pixels, K, votes)
    for guess in guesses[1:]:
        if is_sure(best):
            break
        other = _refined(guess, points, spread, pixels, K, votes)
        best = max(best, other, key=lambda pose: _support(pose, votes))
    if not is_sure(best):
        start = consensus(points[votes], pixels[votes], K, _SAMPLES, INLIER_PX, seed)
        if start is not None:
            other = _refined(start[0], points, spread, pixels, K, votes)
            best = max(best, other, key=lambda pose: _support(pose, votes))
    return best


def _refined(
    T_camera_world: FloatArray,
    points: FloatArray,
    spread: FloatArray | None,
    pixels: FloatArray,
    K: FloatArray,
    votes: NDArray[np.bool_],
) -> Resection:
    """Cauchy weights of half an inlier; far from the solution, where all residuals are large, of their median."""
    T = T_camera_world.copy()
    focal = np.array([K[0, 0], K[1, 1]])
    rays = (pixels - K[:2, 2]) / focal
    residual, J, X = _whitened(T, points, spread, rays, focal)
    for _ in range(_ITERATIONS):
        norm = np.hypot(*residual)
        scale = max(0.5 * INLIER_PX, median(norm[votes]))
        weight = np.where(votes & (X[:, 2] > LEAST_DEPTH), 1.0 / (1.0 + (norm / scale) ** 2), 0.0)
        weighted = (weight * J).reshape(6, -1)
        information = weighted @ J.reshape(6, -1).T
        information += (1e-9 + _DAMPING * np.trace(information)) * np.eye(6)
        step = np.asarray(np.linalg.solve(information, -weighted @ residual.ravel()), np.float64)
        T = compose(make(rotation_matrix(step[:3]), step[3:]), T)
        residual, J, X = _whitened(T, points, spread, rays, focal)
        if np.abs(step).max() < _CONVERGED:
            break
    in_front = X[:, 2] > LEAST_DEPTH
    sigma = max(mad_sigma(residual[:, votes]), _LEAST_PIXEL_SIGMA)
    sigmas = sigma * np.sqrt(np.diag(np.linalg.inv(information)))
    return Resection(T, np.where(in_front, np.hypot(*residual), np.inf), sigmas)


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
    taken = (1.0 - PIXEL_SIGMA / np.sqrt(PIXEL_SIGMA**2 + square)) / square
    residual, J = (of - (taken * (of * line).sum(axis=-2))[..., None, :] * line for of in (residual, J))
    return residual, J, X


def pixel_jacobian(X: FloatArray, focal: FloatArray) -> FloatArray:
    """Derivatives ``(6, 2, M)`` of pixels by the camera's perturbation, at points ``(M, 3)`` in the camera."""
    x, y, inverse = X[:, 0], X[:, 1], 1.0 / np.maximum(X[:, 2], LEAST_DEPTH)
    u, v = x * inverse, y * inverse
    J = np.zeros((6, 2, len(X)))  # points last: arithmetic on long rows
    J[0, 0], J[1, 0], J[2, 0], J[3, 0], J[5, 0] = -u * v, 1.0 + u * u, -v, inverse, -u * inverse
    J[0, 1], J[1, 1], J[2, 1], J[4, 1], J[5, 1] = -1.0 - v * v, u * v, u, inverse, -v * inverse
    J *= focal[:, None]
    return J
