"""Rigid transforms as 4x4 float64 matrices.

``T_a_b`` takes coordinates in b to coordinates in a; neighbours cancel (``docs/design/conventions.md``).
Functions accept stacks: any leading shape before ``(4, 4)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Rows = NDArray[np.intp]  # by number


def make(R_a_b: FloatArray, t_a_b: FloatArray) -> FloatArray:
    """Assemble ``T_a_b`` ``(..., 4, 4)`` from ``R_a_b`` ``(..., 3, 3)`` and ``t_a_b`` ``(..., 3)``, metres."""
    T_a_b = np.zeros((*R_a_b.shape[:-2], 4, 4))
    T_a_b[..., :3, :3] = R_a_b
    T_a_b[..., :3, 3] = t_a_b
    T_a_b[..., 3, 3] = 1.0
    return T_a_b


def invert(T_a_b: FloatArray) -> FloatArray:
    """``T_b_a`` of ``T_a_b``, both ``(..., 4, 4)``."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    return make(R_b_a, -(R_b_a @ T_a_b[..., :3, 3:])[..., 0])


def in_unit(T_a_b: FloatArray, per_unit: float) -> FloatArray:
    """A transform ``(4, 4)`` with its translation in another unit, of which an old one has ``per_unit``."""
    return make(T_a_b[:3, :3], per_unit * T_a_b[:3, 3])


def apply(T_a_b: FloatArray, points_b: FloatArray) -> FloatArray:
    """Points ``(N, 3)`` in b, moved to a by one ``(4, 4)`` transform."""
    points_a: FloatArray = points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    return points_a


def length_of(vector: ArrayLike) -> float:
    """Euclidean length of a vector ``(D,)``."""
    return float(np.linalg.norm(vector))


def normalised(vectors: FloatArray) -> FloatArray:
    """The vectors ``(N, D)`` at unit length."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def rotation_angle(R: FloatArray) -> FloatArray:
    """Angle in radians of a rotation ``(3, 3)`` or of many ``(N, 3, 3)``, in [0, pi], accurate at both ends."""
    return np.asarray(Rotation.from_matrix(R).magnitude())


def compose(T_a_b: FloatArray, T_b_c: FloatArray) -> FloatArray:
    """``T_a_c`` ``(..., 4, 4)`` of two transforms, or ``R_a_c`` ``(..., 3, 3)`` of two rotations.

    Where a result is the start of the next, rounding adds up: a step that is predicted from the last two poses, and so
    on, more than doubles it. One step of Newton's towards the nearest rotation keeps it at that of one product.
    """
    T_a_c = T_a_b @ T_b_c
    R = T_a_c[..., :3, :3]
    T_a_c[..., :3, :3] = 1.5 * R - 0.5 * R @ np.swapaxes(R, -1, -2) @ R
    return T_a_c


def chain(T_previous_next: FloatArray) -> FloatArray:
    """Poses ``(N + 1, 4, 4)`` in the first frame from N increments ``T_previous_next`` ``(N, 4, 4)``."""
    T_first_k = np.tile(np.eye(4), (len(T_previous_next) + 1, 1, 1))
    for k, increment in enumerate(rigid(T_previous_next)):
        T_first_k[k + 1] = compose(T_first_k[k], increment)
    return T_first_k


def interpolate(T_world_camera: FloatArray, known: FloatArray, stamps: FloatArray) -> FloatArray:
    """Poses ``(N, 4, 4)`` at ``stamps`` ``(N,)`` from poses ``(M, 4, 4)`` at ``known`` ``(M,)``; ends are held."""
    times = np.clip(stamps, known[0], known[-1])
    R = Slerp(known, Rotation.from_matrix(T_world_camera[:, :3, :3]))(times).as_matrix()
    return make(R, interpolated(times, known, T_world_camera[:, :3, 3]))


def interpolated(at: FloatArray, known: NDArray[Any], points: FloatArray) -> FloatArray:
    """Points ``(M, D)`` at places or times ``(M,)`` on the path through points ``(N, D)`` at known ones ``(N,)``."""
    return np.stack([np.interp(at, known, axis) for axis in points.T], axis=-1)


def path_distance(T_world_camera: FloatArray) -> FloatArray:
    """Distance travelled ``(N,)`` up to each of the poses ``(N, 4, 4)``."""
    return distance_along(T_world_camera[:, :3, 3])


def distance_along(points: FloatArray) -> FloatArray:
    """Distance along a polyline ``(N,)`` up to each of its points ``(N, D)``."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def nearest_rotation(M: FloatArray) -> FloatArray:
    """The rotations ``(..., 3, 3)`` closest to M in the Frobenius norm (orthogonal Procrustes by SVD)."""
    U, _, Vt = np.linalg.svd(M)
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    R: FloatArray = U @ Vt
    return R


def rigid(T_a_b: FloatArray) -> FloatArray:
    """Transforms ``(..., 4, 4)`` with the rotations closest to theirs: those of networks have seven digits."""
    return make(nearest_rotation(T_a_b[..., :3, :3]), T_a_b[..., :3, 3])


def rotation_matrix(rotation_vector: FloatArray) -> FloatArray:
    """``R_a_b`` ``(3, 3)`` from one axis times angle in radians ``(3,)``, in a twentieth of the time of SciPy's."""
    return cv2.Rodrigues(rotation_vector)[0]


def from_rotation_vector(rotation_vector: FloatArray, t_a_b: FloatArray) -> FloatArray:
    """``T_a_b`` from axis times angle in radians ``(..., 3)`` and translation ``(..., 3)``."""
    return make(Rotation.from_rotvec(rotation_vector).as_matrix(), t_a_b)


def tangent(T_a_b: FloatArray) -> FloatArray:
    """Rotation vectors and translations ``(N, 6)`` of ``(N, 4, 4)``: GTSAM's order, for small differences."""
    return np.hstack([Rotation.from_matrix(T_a_b[:, :3, :3]).as_rotvec(), T_a_b[:, :3, 3]])


def is_se3(T_a_b: FloatArray, tolerance: float = 1e-5) -> bool:
    """Whether every matrix of the stack is a finite rigid transform."""
    if T_a_b.shape[-2:] != (4, 4) or not np.isfinite(T_a_b).all():
        return False
    return np.allclose(T_a_b, rigid(T_a_b), rtol=0.0, atol=tolerance)


@dataclass(frozen=True)
class Similarity:
    """``p_a = scale * R_a_b @ p_b + t_a_b``."""

    scale: float
    R_a_b: FloatArray
    t_a_b: FloatArray

    def apply(self, points_b: FloatArray) -> FloatArray:
        """Points ``(N, 3)`` in b expressed in a."""
        return self.scale * points_b @ self.R_a_b.T + self.t_a_b

    def apply_to_poses(self, T_b_k: FloatArray) -> FloatArray:
        """Poses ``(N, 4, 4)`` in b expressed in a: positions scaled, rotations turned."""
        return make(self.R_a_b @ T_b_k[:, :3, :3], self.apply(T_b_k[:, :3, 3]))


def umeyama(points_a: FloatArray, points_b: FloatArray, with_scale: bool) -> Similarity:
    """Least-squares similarity that takes ``points_b`` ``(N, 3)`` onto ``points_a`` ``(N, 3)``.

    Umeyama 1991, Eqs. 40-42. With all points of b in one place the scale is undefined and stays 1.
    """
    mean_a, mean_b = points_a.mean(axis=0), points_b.mean(axis=0)
    centred_a, centred_b = points_a - mean_a, points_b - mean_b
    covariance = centred_a.T @ centred_b
    R_a_b, variance_b = nearest_rotation(covariance), (centred_b**2).sum()
    is_scaled = with_scale and variance_b > 0
    scale = float((R_a_b * covariance).sum() / variance_b) if is_scaled else 1.0
    return Similarity(scale, R_a_b, mean_a - scale * R_a_b @ mean_b)


def equal_step(T_a_b: FloatArray, n: int) -> FloatArray:
    """One of n equal steps from a to b: the transform ``(4, 4)`` whose n-th power is ``T_a_b``."""
    rotation_vector = Rotation.from_matrix(T_a_b[:3, :3]).as_rotvec() / n
    powers = Rotation.from_rotvec(np.arange(n)[:, None] * rotation_vector).as_matrix()
    return from_rotation_vector(rotation_vector, np.linalg.solve(powers.sum(axis=0), T_a_b[:3, 3]))
