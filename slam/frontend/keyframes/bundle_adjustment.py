"""Bundle adjustment: cameras and points that fit all sightings best, by Levenberg-Marquardt on the Schur complement.

As in Triggs et al. 2000, section 6.1: the points are eliminated, the cameras' reduced system is
solved, dense for a window and sparse for all keyframes of a map, the points follow. A camera is
perturbed on the left, ``Exp(xi) T_camera_world``, rotation first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import compress, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import bsr_array
from scipy.sparse.linalg import splu

from slam.frames import Intrinsics
from slam.geometry.multiview import LEAST_DEPTH, PIXEL_SIGMA, pixel_jacobian
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray, apply, compose, from_rotation_vector

_ROBUST = 1.5  # sigmas beyond which residuals weigh less
_FIRST_DAMPING = 1e-4
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e6
_ROUNDS = 5  # of Huber's location
_MOST_DENSE = 900  # unknowns of 150 cameras: each of more shares points with few others only

_StepByDamping = Callable[[float], tuple[FloatArray, FloatArray] | None]


@dataclass(frozen=True)
class Sightings:
    """``S`` sightings of points by cameras, in their order: rows of both ``(S,)``, ``pixels`` ``(S, 2)``, ``depth``.

    Depth ``(S,)`` is that in the camera by its prior, in a unit of this image, with ``depth_sigma``
    of its logarithm ``(S,)``; NaN for none. A point is seen at most once by a camera.
    """

    camera: NDArray[np.int64]
    point: NDArray[np.int64]
    pixels: FloatArray
    depth: FloatArray
    depth_sigma: FloatArray

    def __len__(self) -> int:
        return len(self.camera)


@dataclass(frozen=True)
class Adjusted:
    """Cameras ``T_camera_world`` ``(K, 4, 4)``, ``points`` ``(P, 3)`` in the world, ``residual_px`` ``(S,)``, the cost.

    Behind a camera the residual is infinite.
    """

    T_camera_world: FloatArray
    points: FloatArray
    residual_px: FloatArray
    cost: float


class BundleAdjustment:
    """One problem: what is seen by whom, and which cameras are free."""

    def __init__(
        self,
        sightings: Sightings,
        intrinsics: Intrinsics,
        free: NDArray[np.bool_],
        robust: float = _ROBUST,
    ) -> None:
        """Prepare to adjust cameras and points.

        Args:
            sightings: of the points by the cameras.
            intrinsics: of all cameras.
            free: cameras that are adjusted ``(K,)``; the others stay.
            robust: sigmas beyond which residuals weigh less.
        """
        self._seen, self._robust = sightings, robust
        self._focal = np.array([intrinsics.fx, intrinsics.fy])
        self._rays = intrinsics.rays(sightings.pixels)[:, :2]
        self._log_depth = np.log(sightings.depth)
        self._learned = np.isfinite(self._log_depth)
        self._log_depth[~self._learned] = 0.0
        # images of one point share the network's error
        self._points = int(sightings.point.max(initial=-1)) + 1
        times = np.bincount(sightings.point[self._learned], minlength=self._points)
        self._depth_sigma = sightings.depth_sigma * np.sqrt(np.maximum(times[sightings.point], 1))
        self._free = free
        ends = np.searchsorted(sightings.camera, np.arange(len(free) + 1))
        self._rows = [slice(*each) for each in pairwise(ends.tolist())]
        _, self._image = np.unique(sightings.camera[self._learned], return_inverse=True)
        # sightings by free cameras, and where those of each begin among them
        self._of_free = np.flatnonzero(free[sightings.camera])
        self._begins = np.concatenate([[0], np.cumsum(np.diff(ends)[free])])

    def solve(
        self,
        T_camera_world: FloatArray,
        points: FloatArray,
        iterations: int,
        tolerance: float = 1e-4,
    ) -> Adjusted:
        """Adjust from a start.

        Args:
            T_camera_world: of all cameras ``(K, 4, 4)``.
            points: in the world ``(P, 3)``.
            iterations: the most.
            tolerance: the relative fall of the cost at which it ends.
        """
        T, X = T_camera_world.copy(), points.copy()
        residuals = self.residuals(T, X)
        cost = self._cost(residuals)
        damping = _FIRST_DAMPING
        step_by = None
        for _ in range(iterations):
            step_by = step_by or self._normal_equations(T, X, residuals)
            step = step_by(damping)
            before = cost
            if step is not None:
                by_camera, by_point = step
                T_new, X_new = T.copy(), X.copy()
                T_new[self._free] = compose(
                    from_rotation_vector(by_camera[:, :3], by_camera[:, 3:]), T[self._free]
                )
                X_new[: self._points] += by_point
                residuals_new = self.residuals(T_new, X_new)
                cost_new = self._cost(residuals_new)
                if cost_new <= cost:
                    T, X, residuals, cost, step_by = T_new, X_new, residuals_new, cost_new, None
                    damping = max(0.1 * damping, _LEAST_DAMPING)
                    if before - cost <= tolerance * before:
                        break
                    continue
            damping *= 10.0
            if damping > _MOST_DAMPING:
                break
        pixel = np.linalg.norm(residuals[:, :2], axis=1) * PIXEL_SIGMA
        return Adjusted(
            T, X, np.where(self._in_cameras(T, X)[:, 2] > LEAST_DEPTH, pixel, np.inf), cost
        )

    def residuals(self, T_camera_world: FloatArray, points: FloatArray) -> FloatArray:
        """Of both pixel coordinates and of the logarithm of depth, over their sigmas ``(S, 3)``."""
        X = self._in_cameras(T_camera_world, points)
        z = np.maximum(X[:, 2:], LEAST_DEPTH)
        found = np.empty((len(X), 3))
        found[:, :2] = (X[:, :2] / z - self._rays) * self._focal / PIXEL_SIGMA
        found[:, 2] = self._relief(np.log(z[:, 0]) - self._log_depth)
        return found

    def _relief(self, logarithms: FloatArray) -> FloatArray:
        """Residuals of depth ``(S,)`` without what those of an image have in common, which is Huber's location.

        It is where an adjustment of the images' units would end, so that derivatives need not know
        it.
        """
        own, sigma = logarithms[self._learned], self._depth_sigma[self._learned]
        image, near, full = self._image, self._robust * sigma, sigma**-2
        parts = np.split(own, np.flatnonzero(np.diff(image)) + 1)  # image by image
        unit = np.array([median(part) for part in parts])
        for _ in range(_ROUNDS):
            weight = full * np.minimum(1.0, near / np.maximum(np.abs(own - unit[image]), 1e-9))
            unit = np.bincount(image, weight * own) / np.bincount(image, weight)
        whitened = np.zeros(len(logarithms))
        whitened[self._learned] = (own - unit[image]) / sigma
        return whitened

    def jacobians(
        self, T_camera_world: FloatArray, points: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Derivatives of the residuals by their camera's perturbation ``(6, 3, S)`` and their point ``(3, 3, S)``."""
        X = self._in_cameras(T_camera_world, points)
        by_camera = np.zeros((6, 3, len(X)))
        by_camera[:, :2] = pixel_jacobian(X, self._focal / PIXEL_SIGMA)
        scale = self._learned / (self._depth_sigma * np.maximum(X[:, 2], LEAST_DEPTH))
        by_camera[0, 2], by_camera[1, 2], by_camera[5, 2] = X[:, 1] * scale, -X[:, 0] * scale, scale
        by_point = np.empty((3, 3, len(X)))
        for T, rows in zip(T_camera_world, self._rows, strict=True):
            by_point[..., rows] = np.tensordot(T[:3, :3].T, by_camera[3:, :, rows], 1)
        return by_camera, by_point

    def _in_cameras(self, T_camera_world: FloatArray, points: FloatArray) -> FloatArray:
        X = points[self._seen.point]
        for T, rows in zip(T_camera_world, self._rows, strict=True):
            X[rows] = apply(T, X[rows])
        return X

    def _cost(self, residuals: FloatArray) -> float:
        """Cauchy's of pixels, for corners in reflections agree on a motion of their own, and Huber's of depth."""
        (pixel, depth), k = self._lengths(residuals).T, self._robust
        by_depth = np.where(depth < k, 0.5 * depth**2, k * (depth - 0.5 * k))
        return float((0.5 * k**2 * np.log1p((pixel / k) ** 2) + by_depth).sum())

    def _lengths(self, residuals: FloatArray) -> FloatArray:
        """Of the residual of the pixel, and of that of depth ``(S, 2)``."""
        return np.stack([np.linalg.norm(residuals[:, :2], axis=1), np.abs(residuals[:, 2])], axis=1)

    def weights(self, residuals: FloatArray) -> FloatArray:
        """Square roots of the weights of the residuals ``(S, 3)``."""
        pixel, depth = self._lengths(residuals).T / self._robust
        by_pixel, by_depth = 1.0 / np.hypot(1.0, pixel), np.maximum(depth, 1.0) ** -0.5
        return np.stack([by_pixel, by_pixel, by_depth], axis=1)

    def _normal_equations(
        self, T: FloatArray, X: FloatArray, residuals: FloatArray
    ) -> _StepByDamping:
        """Steps of cameras ``(F, 6)`` and points ``(P, 3)`` by the damping, None where the system is singular.

        Its parts are those of cameras ``U`` ``(F, 6, 6)`` and points ``V`` ``(P, 3, 3)``, their
        coupling ``W`` ``(6, 3, S)``, and the right sides.
        """
        root = self.weights(residuals)
        by_camera, by_point = self.jacobians(T, X)
        A, B = root.T * by_camera, root.T * by_point
        r = (root * residuals).T
        own, own_sides = [], []
        for rows in compress(self._rows, self._free):
            J = A[..., rows].reshape(6, -1)
            own.append(J @ J.T)
            own_sides.append(-J @ r[:, rows].ravel())
        U, camera_side = np.array(own), np.array(own_sides)
        point, points = self._seen.point, self._points
        V, point_side = np.empty((points, 3, 3)), np.empty((points, 3))
        for i in range(3):
            point_side[:, i] = -np.bincount(point, (B[i] * r).sum(axis=0), points)
            for j in range(i + 1):
                V[:, i, j] = V[:, j, i] = np.bincount(point, (B[i] * B[j]).sum(axis=0), points)
        W = A[:, None, 0] * B[:, 0] + A[:, None, 1] * B[:, 1] + A[:, None, 2] * B[:, 2]
        blocks = W[..., self._of_free].transpose(2, 0, 1)
        coupling = bsr_array((blocks, point[self._of_free], self._begins), (6 * len(U), 3 * points))
        of_cameras, of_points = camera_side.ravel(), point_side.ravel()

        def step(damping: float) -> tuple[FloatArray, FloatArray] | None:
            V_inverse = _diagonal(np.linalg.inv(_damped(V, damping)))
            with_points = coupling @ V_inverse
            # the cameras' system without the points
            system = _diagonal(_damped(U, damping)) - with_points @ coupling.T
            by_camera = _solved(system, of_cameras - with_points @ of_points)
            if by_camera is None:
                return None
            by_point = V_inverse @ (of_points - coupling.T @ by_camera)
            return by_camera.reshape(-1, 6), by_point.reshape(-1, 3)

        return step


def _diagonal(blocks: NDArray[np.floating[Any]]) -> bsr_array:
    """The matrix with square blocks ``(B, n, n)`` along its diagonal."""
    return bsr_array((blocks, np.arange(len(blocks)), np.arange(len(blocks) + 1)))


def _damped(blocks: FloatArray, damping: float) -> FloatArray:
    diagonal = np.einsum("kii->ki", blocks)
    added = damping * np.maximum(diagonal, 1e-6) + 1e-12
    return blocks + added[:, :, None] * np.eye(blocks.shape[1])


def _solved(system: bsr_array, side: FloatArray) -> FloatArray | None:
    """The solution of a symmetric system, positive definite; None where it is singular."""
    try:
        if len(side) <= _MOST_DENSE:
            factor = cho_factor(system.toarray(), check_finite=False)
            return np.asarray(cho_solve(factor, side, check_finite=False))
        # as a symmetric one: its pattern decides the order, and pivots stay on the diagonal
        factors = splu(
            system.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except (LinAlgError, RuntimeError):
        return None
    return np.asarray(factors.solve(side))
