"""Two-view geometry of calibrated points: motions by consensus, and triangulation.

A motion is ``x_current ~ R_current_previous @ X_previous + direction``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np

from slam.geometry.resection import consensus, ransac_order
from slam.geometry.se3 import FloatArray, invert, nearest_rotation

_TRIMMINGS = 4
_RESECTIONS = 200
_LEAST_POINTS = 8


@dataclass(frozen=True)
class UnitRelativePose:
    """A motion between two views without its length: ``direction`` ``(3,)`` in the current camera, unit length."""

    R_current_previous: FloatArray
    direction: FloatArray

    @classmethod
    def of(cls, T_previous_current: FloatArray) -> tuple[Self, float] | None:
        """That of a pose, and its length; None where it has none."""
        T_current_previous = invert(T_previous_current)
        length = float(np.linalg.norm(T_current_previous[:3, 3]))
        return (cls(T_current_previous[:3, :3], T_current_previous[:3, 3] / length), length) if length > 0 else None


def unit_pose_by_essential(
    rays_previous: FloatArray, rays_current: FloatArray, tolerance: float, seed: int = 0
) -> UnitRelativePose | None:
    """The motion with most support among matched rays ``(M, 3)`` with z = 1, within ``tolerance`` on z = 1."""
    order = ransac_order(len(rays_previous), seed)
    rays_previous, rays_current = rays_previous[order], rays_current[order]
    cv2.setRNGSeed(seed)
    E, mask = cv2.findEssentialMat(
        rays_previous[:, :2].copy(),
        rays_current[:, :2].copy(),
        np.eye(3),
        method=cv2.USAC_MAGSAC,
        prob=0.999,
        threshold=tolerance,
        maxIters=1000,
    )
    if E is None or E.shape != (3, 3) or int(mask.sum()) < _LEAST_POINTS:
        return None
    inliers = mask.ravel().astype(bool)
    return _in_front(E, rays_previous[inliers], rays_current[inliers])


def _in_front(E: FloatArray, rays_previous: FloatArray, rays_current: FloatArray) -> UnitRelativePose:
    """Of the four motions of an essential matrix the one with most points in front of both cameras."""
    R, R_twisted, direction = cv2.decomposeEssentialMat(E)
    unit_poses = [
        UnitRelativePose(rotated, sign * direction.ravel()) for rotated in (R, R_twisted) for sign in (1.0, -1.0)
    ]

    def in_front_of_both(unit_pose: UnitRelativePose) -> int:
        depth = triangulated_depth(rays_previous, rays_current, unit_pose)
        return int(((depth > 0) & (depth_in_current(rays_previous, depth, unit_pose) > 0)).sum())

    return max(unit_poses, key=in_front_of_both)


def unit_poses_by_homography(
    rays_previous: FloatArray, rays_current: FloatArray, tolerance: float, seed: int = 0
) -> list[UnitRelativePose]:
    """The motions, at most two, by which a plane explains the matched rays ``(M, 3)`` with z = 1, within ``tolerance``.

    The plane must lie in front of the previous camera where its inliers see it.
    """
    order = ransac_order(len(rays_previous), seed)
    rays_previous, rays_current = rays_previous[order], rays_current[order]
    cv2.setRNGSeed(seed)
    H, mask = cv2.findHomography(
        rays_previous[:, :2].copy(), rays_current[:, :2].copy(), cv2.USAC_MAGSAC, tolerance, maxIters=1000
    )
    if H is None or int(mask.sum()) < _LEAST_POINTS:
        return []
    inliers = rays_previous[mask.ravel().astype(bool)]
    _, rotations, translations, normals = cv2.decomposeHomographyMat(H, np.eye(3))
    return [
        UnitRelativePose(R, t.ravel() / np.linalg.norm(t))
        for R, t, normal in zip(rotations, translations, normals, strict=True)
        if np.linalg.norm(t) > 0 and np.median(inliers @ normal) > 0
    ]


def unit_pose_by_pnp(
    rays_previous: FloatArray, rays_current: FloatArray, depth_previous: FloatArray, tolerance: float, seed: int = 0
) -> UnitRelativePose | None:
    """The motion with most support among the same rays where their depths ``(M,)`` are known, else NaN.

    Known depth separates dynamic objects from the static scene.
    """
    known = np.isfinite(depth_previous)
    if known.sum() < _LEAST_POINTS:
        return None
    points = rays_previous[known] * depth_previous[known, None]
    pose = consensus(points, rays_current[known, :2].copy(), np.eye(3), _RESECTIONS, tolerance, seed)
    if pose is None:
        return None
    T_current_previous, _ = pose
    length = float(np.linalg.norm(T_current_previous[:3, 3]))
    return UnitRelativePose(T_current_previous[:3, :3], T_current_previous[:3, 3] / length) if length > 0 else None


def parallax_px(
    rays_previous: FloatArray,
    rays_current: FloatArray,
    R_current_previous: FloatArray,
    focal: tuple[float, float],
) -> FloatArray:
    """Optical flow of each point in pixels ``(M,)`` without that of the rotation."""
    rotated = rays_previous @ R_current_previous.T
    rotated = rotated[:, :2] / np.where(rotated[:, 2:] > 1e-6, rotated[:, 2:], 1e-6)
    difference = (rays_current[:, :2] - rotated) * focal
    return np.asarray(np.linalg.norm(difference, axis=1))


def rotation_between(rays_previous: FloatArray, rays_current: FloatArray) -> FloatArray:
    """``R_current_previous`` that fits the matched rays ``(M, 3)`` best without translation.

    Orthogonal Procrustes on unit rays, trimmed to the better three quarters, so that dynamic objects do not bias it.
    """
    unit_previous = rays_previous / np.linalg.norm(rays_previous, axis=1, keepdims=True)
    unit_current = rays_current / np.linalg.norm(rays_current, axis=1, keepdims=True)
    kept = np.ones(len(unit_previous), dtype=bool)
    most = 3 * len(unit_previous) // 4
    for _ in range(_TRIMMINGS):
        R_current_previous = nearest_rotation(unit_current[kept].T @ unit_previous[kept])
        error = np.linalg.norm(unit_current - unit_previous @ R_current_previous.T, axis=1)
        kept = error <= np.partition(error, most)[most]
    return R_current_previous


def triangulated_depth(rays_previous: FloatArray, rays_current: FloatArray, unit_pose: UnitRelativePose) -> FloatArray:
    """z-depth ``(M,)`` in the previous camera in units of the motion's length; negative behind the camera.

    From ``z R x + t = z' x'``: the cross product with x' leaves ``z (x' x R x) = -(x' x t)``.
    """
    across, along = _across_and_along(rays_previous, rays_current, unit_pose)
    return np.asarray((across * along).sum(axis=0) / np.maximum((across**2).sum(axis=0), 1e-18))


def triangulated_nearness(
    rays_previous: FloatArray, rays_current: FloatArray, unit_pose: UnitRelativePose
) -> tuple[FloatArray, FloatArray]:
    """1 over z-depth ``(M,)``, 0 or less at and beyond infinity, and its sigma ``(M,)`` by a ray's sigma of 1.

    Linear in the shift of a point, so that noise does not bias it. The inverse of `triangulated_depth` is biased: noise
    counts as a shift there, and brings far points nearer.
    """
    across, along = _across_and_along(rays_previous, rays_current, unit_pose)
    squared = np.maximum((along**2).sum(axis=0), 1e-18)
    return np.asarray((across * along).sum(axis=0) / squared), np.asarray(1.0 / np.sqrt(squared))


def _across_and_along(
    rays_previous: FloatArray, rays_current: FloatArray, unit_pose: UnitRelativePose
) -> tuple[FloatArray, FloatArray]:
    """The two sides ``(3, M)`` of ``z (x' x R x) = -(x' x t)``."""
    current = rays_current.T
    return cross(current, unit_pose.R_current_previous @ rays_previous.T), -cross(current, unit_pose.direction)


def depth_in_current(rays_previous: FloatArray, depth_previous: FloatArray, unit_pose: UnitRelativePose) -> FloatArray:
    """z-depth ``(M,)`` in the current camera of points at ``depth_previous`` ``(M,)``, both in the motion's length."""
    return np.asarray(depth_previous * (rays_previous @ unit_pose.R_current_previous[2]) + unit_pose.direction[2])


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """``a x b`` of ``(3,)`` or ``(3, M)``; several times faster than NumPy's own."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
