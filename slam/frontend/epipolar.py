"""Two-view geometry of calibrated points: rotation and direction of motion with their covariance.

The essential matrix of a consensus (cv2) starts a refinement that minimises the Sampson distance
(Hartley and Zisserman 2004, Eq. 11.9) over rotation and direction, reweighted against outliers.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam.frames import Intrinsics
from slam.se3 import FloatArray, nearest_rotation

_ITERATIONS = 10
_TRIMMINGS = 4
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class TwoView:
    """``x_current ~ R_current_previous @ X_previous + direction``, the direction ``(3,)`` of unit length.

    ``covariance`` ``(6, 6)``: rotation then direction, both in the current camera, radians.
    ``inliers`` ``(M,)`` marks the points that fit.
    """

    R_current_previous: FloatArray
    direction: FloatArray
    covariance: FloatArray
    inliers: NDArray[np.bool_]


@dataclass(frozen=True)
class Structure:
    """``M`` scene points that a motion triangulated, by the names of their tracks ``(M,)``.

    z-depths ``(M,)`` in both cameras are in units of the motion's length; ``sigma_share`` ``(M,)`` is relative.
    """

    names: NDArray[np.int64]
    depth_previous: FloatArray
    depth_current: FloatArray
    sigma_share: FloatArray


def estimate_two_view(
    rays_previous: FloatArray, rays_current: FloatArray, focal_px: float, inlier_px: float
) -> TwoView | None:
    """Rotation and direction of motion from matched rays ``(M, 3)`` with z = 1; None without a consensus."""
    cv2.setRNGSeed(0)
    threshold = inlier_px / focal_px
    E, mask = cv2.findEssentialMat(
        rays_previous[:, :2].copy(),
        rays_current[:, :2].copy(),
        np.eye(3),
        method=cv2.USAC_MAGSAC,
        prob=0.999,
        threshold=threshold,
        maxIters=1000,
    )
    if E is None or E.shape != (3, 3) or int(mask.sum()) < 8:
        return None
    _, R, direction, _ = cv2.recoverPose(
        E, rays_previous[:, :2].copy(), rays_current[:, :2].copy(), np.eye(3), mask=mask.copy()
    )
    return _refined(rays_previous, rays_current, R, direction.ravel(), threshold)


def parallax_px(
    rays_previous: FloatArray,
    rays_current: FloatArray,
    R_current_previous: FloatArray,
    intrinsics: Intrinsics,
) -> FloatArray:
    """Motion of each point in pixels ``(M,)`` that the rotation does not explain."""
    turned = rays_previous @ R_current_previous.T
    turned = turned[:, :2] / np.where(turned[:, 2:] > 1e-6, turned[:, 2:], 1e-6)
    difference = (rays_current[:, :2] - turned) * [intrinsics.fx, intrinsics.fy]
    return np.asarray(np.linalg.norm(difference, axis=1))


def rotation_between(rays_previous: FloatArray, rays_current: FloatArray) -> FloatArray:
    """``R_current_previous`` that explains the matched rays ``(M, 3)`` best without any translation.

    Orthogonal Procrustes on unit rays, trimmed to the better three quarters so that movers do not turn it.
    """
    unit_previous = rays_previous / np.linalg.norm(rays_previous, axis=1, keepdims=True)
    unit_current = rays_current / np.linalg.norm(rays_current, axis=1, keepdims=True)
    kept = np.ones(len(unit_previous), dtype=bool)
    for _ in range(_TRIMMINGS):
        R_current_previous = nearest_rotation(unit_current[kept].T @ unit_previous[kept])
        error = np.linalg.norm(unit_current - unit_previous @ R_current_previous.T, axis=1)
        kept = error <= np.quantile(error, 0.75)
    return R_current_previous


def triangulated_depth(rays_previous: FloatArray, rays_current: FloatArray, two_view: TwoView) -> FloatArray:
    """z-depth ``(M,)`` in the previous camera in units of the motion's length; negative behind the camera.

    From ``z R x + t = z' x'``: the cross product with x' leaves ``z (x' x R x) = -(x' x t)``.
    """
    across = _cross(rays_current, rays_previous @ two_view.R_current_previous.T)
    along = -_cross(rays_current, two_view.direction)
    return np.asarray((across * along).sum(axis=1) / np.maximum((across**2).sum(axis=1), 1e-18))


def _refined(
    rays_previous: FloatArray,
    rays_current: FloatArray,
    R: FloatArray,
    direction: FloatArray,
    threshold: float,
) -> TwoView | None:
    """Gauss-Newton with Cauchy weights; the parameters are a left rotation and a tangent of the direction."""
    for iteration in range(_ITERATIONS):
        residual, jacobian, tangent = _sampson(rays_previous, rays_current, R, direction)
        inliers = np.abs(residual) < threshold
        if inliers.sum() < 8:
            return None
        sigma = max(_MAD_TO_SIGMA * float(np.median(np.abs(residual[inliers]))), 1e-3 * threshold)
        weights = inliers / (1.0 + (residual / (2.0 * sigma)) ** 2)
        normal = jacobian.T @ (weights[:, None] * jacobian) + 1e-12 * np.eye(5)
        step = -np.linalg.solve(normal, jacobian.T @ (weights * residual))
        if iteration == _ITERATIONS - 1 or np.abs(step).max() < 1e-6:
            break
        R = Rotation.from_rotvec(step[:3]).as_matrix() @ R
        direction = direction + tangent @ step[3:]
        direction = direction / np.linalg.norm(direction)
    lift = np.zeros((6, 5))
    lift[:3, :3], lift[3:, 3:] = np.eye(3), tangent
    covariance = sigma**2 * lift @ np.linalg.inv(normal) @ lift.T
    return TwoView(R, direction, covariance, inliers)


def _sampson(
    rays_previous: FloatArray, rays_current: FloatArray, R: FloatArray, direction: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sampson distances ``(M,)``, their Jacobian ``(M, 5)`` and the tangent ``(3, 2)`` of the direction.

    The gradient's norm is held fixed in the Jacobian, as in reweighted least squares.
    """
    turned = rays_previous @ R.T
    lines_current = _cross(direction, turned)  # E x
    across = _cross(rays_current, direction)
    lines_previous = across @ R  # E^T x'
    algebraic = (rays_current * lines_current).sum(axis=1)
    gradient = np.sqrt((lines_current[:, :2] ** 2).sum(axis=1) + (lines_previous[:, :2] ** 2).sum(axis=1))
    gradient = np.maximum(gradient, 1e-9)
    axis = np.eye(3)[np.abs(direction).argmin()]
    first = _cross(direction, axis)
    first = first / np.linalg.norm(first)
    tangent = np.stack([first, _cross(direction, first)], axis=1)
    by_rotation = _cross(turned, across)
    by_direction = _cross(turned, rays_current) @ tangent
    jacobian = np.concatenate([by_rotation, by_direction], axis=1) / gradient[:, None]
    return algebraic / gradient, jacobian, tangent


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """``a x b`` of ``(3,)`` or ``(M, 3)``; NumPy's own spends most of its time on choosing axes."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)
