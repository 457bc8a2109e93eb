"""Perspective-n-point: camera pose from known points, by RANSAC and refinement, with its covariance.

OpenCV's RANSAC methods have a fixed seed, so ours permutes their points.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.geometry.robust import mad_sigma
from slam.geometry.se3 import FloatArray, make, rotation_matrix

_CONFIDENCE = 0.999
_LEAST_PIXEL_SIGMA = 0.1


@dataclass(frozen=True)
class Resection:
    """``T_camera_points`` takes the points to the camera; ``inliers`` are rows of the points.

    ``sigmas`` ``(6,)``: of rotation and translation in the camera, for independent errors of corners.
    """

    T_camera_points: FloatArray
    inliers: NDArray[np.intp]
    sigmas: FloatArray


def ransac_order(count: int, seed: int) -> NDArray[np.intp]:
    """The order ``(count,)`` of the points for a RANSAC method; seed 0 is the given order."""
    order = np.arange(count, dtype=np.intp)
    return order if seed == 0 else np.random.default_rng(seed).permutation(order)


def consensus(
    points: FloatArray, pixels: FloatArray, K: FloatArray, iterations: int, reprojection_px: float, seed: int = 0
) -> tuple[FloatArray, FloatArray, NDArray[np.intp]] | None:
    """Rotation vector ``(3,)``, translation ``(3,)`` and inlier rows with most support, or None.

    Samples of three points (OpenCV's USAC, without its local optimisation, which `refine` makes needless).

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
    found, _, rotation, translation, chosen = cv2.solvePnPRansac(
        points[order], pixels[order], K.copy(), None, params=params
    )
    if not found or chosen is None:
        return None
    return rotation.ravel(), translation.ravel(), order[chosen.ravel()]


def refine(
    points: FloatArray, pixels: FloatArray, K: FloatArray, start: tuple[FloatArray, FloatArray, NDArray[np.intp]]
) -> Resection:
    """Levenberg-Marquardt on the inliers of `consensus`, with sigmas from the Jacobian and the residuals."""
    rotation, translation, inliers = start
    points, pixels = points[inliers], pixels[inliers]
    rotation, translation = cv2.solvePnPRefineLM(
        points, pixels, K, None, rotation.reshape(3, 1).copy(), translation.reshape(3, 1).copy()
    )
    projected, jacobian = cv2.projectPoints(points, rotation, translation, K, None)
    sigma = max(mad_sigma((projected.reshape(-1, 2) - pixels).ravel()), _LEAST_PIXEL_SIGMA)
    J = jacobian[:, :6]
    sigmas = sigma * np.sqrt(np.diag(np.linalg.inv(J.T @ J + 1e-12 * np.eye(6))))
    T_camera_points = make(rotation_matrix(rotation), translation.ravel())
    return Resection(T_camera_points, inliers, np.asarray(sigmas))
