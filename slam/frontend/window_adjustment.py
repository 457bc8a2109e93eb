"""Bundle adjustment of one window of keyframes whose camera nobody knows: cameras, points and the lens that they share.

Images are measured in half their width from their middle. Along the direction that driving straight on cannot see,
lengths along the axis grow as the focal length and turns shrink: the whole reconstruction is moved along it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from erfsfm.common.readers.camera_file import UNKNOWN_FOV_DEG
from slam.geometry.multiview import pixel_jacobian, resect, unit_pose_by_essential
from slam.geometry.robust import mad_sigma
from slam.geometry.se3 import FloatArray, compose, from_rotation_vector, invert, make

KEYFRAMES, WINDOWS, LEAST_KEYFRAMES = 20, 6, 4
# logarithm of the focal length, both radial coefficients, principal point
PRIOR = np.array([-np.log(np.tan(np.deg2rad(UNKNOWN_FOV_DEG) / 2)), 0.0, 0.0, 0.0, 0.0])
_PRIOR_SIGMAS = np.array([0.5, 0.15, 0.05, 0.024, 0.024])
ALL, BUT_FOCAL, NOTHING = 0, 1, 5  # the first of these that is free
_WIDEST_DEG, _NARROWEST_DEG = 125.0, 32.0  # ends of a profile
_RATIO, _MOST_RISE = 1.15, 30.0  # of its steps, and of its cost above the least
_CAUCHY = 4.0  # squared sigmas
_FIRST_DAMPING, _LEAST_DAMPING = 1e-4, 1e-11
_FARTHEST_STEP, _SETTLED = 0.4, 0.002  # of the logarithm of the focal length
_TURNING = 0.5  # radians beyond which turns are told without the focal length


@dataclass(frozen=True)
class Sightings:
    """``S`` sightings: rows of keyframes and points ``(S,)``, ``image`` ``(S, 2)`` in half widths from the middle."""

    keyframe: NDArray[np.int64]
    point: NDArray[np.int64]
    image: FloatArray

    def __len__(self) -> int:
        return len(self.keyframe)

    def chosen(self, rows: NDArray[Any], least: int) -> tuple[Sightings, NDArray[np.int64]]:
        """Those of points that keep so many, numbered anew, and the points that are kept."""
        keyframe, point, image = self.keyframe[rows], self.point[rows], self.image[rows]
        often = np.bincount(point)[point] >= least
        points, numbers = np.unique(point[often], return_inverse=True)
        return Sightings(keyframe[often], numbers, image[often]), points


@dataclass(frozen=True)
class Reconstruction:
    """``T_camera_world`` ``(K, 4, 4)``, the first the identity, homogeneous ``points`` ``(P, 4)``, and the lens.

    ``lens`` ``(5,)``: log of the focal length, two radial coefficients, principal point, in half widths.
    """

    T_camera_world: FloatArray
    points: FloatArray
    lens: FloatArray

    def stretched(self, ratio: float) -> Reconstruction:
        """The same images under a focal length so many times as long, to first order in the turns."""
        points = normalised(self.points * [1.0, 1.0, ratio, 1.0])
        T_world_camera = invert(self.T_camera_world)
        turns = Rotation.from_matrix(self.T_camera_world[:, :3, :3]).as_rotvec()
        aside = np.maximum(np.linalg.norm(turns[:, :2], axis=1), 1e-9)
        shrunk = np.where(aside < _TURNING, np.arctan(np.tan(aside) / ratio) / aside, 1.0)
        turns[:, :2] *= shrunk[:, None]
        R = Rotation.from_rotvec(turns).as_matrix()
        centres = T_world_camera[:, :3, 3] * [1.0, 1.0, ratio]
        T_camera_world = make(R, -np.einsum("kij,kj->ki", R, centres))
        return Reconstruction(
            T_camera_world, points, self.lens + np.log(ratio) * (np.arange(5) == 0)
        )


class Problem:
    """Bundle adjustment of one window: cameras, homogeneous points and the lens that they share."""

    def __init__(self, seen: Sightings, cameras: int) -> None:
        self.seen, self._cameras = seen, cameras

    def errors(self, given: Reconstruction) -> FloatArray:
        """Of the image of each sighting ``(S, 2)``; infinite behind the camera."""
        ideal, _, before = self._ideal(given)
        error = _bent(ideal, given.lens)[0] - self.seen.image
        return np.where(before[:, None], error, np.inf)

    def spread(self, given: Reconstruction, pixel: float) -> float:
        """Sigma of a coordinate of a sighting."""
        count = 2 * len(self.seen)
        freedom = count - 6 * (self._cameras - 1) - 3 * len(given.points)
        return max(
            mad_sigma(self.errors(given)) * float(np.sqrt(count / max(freedom, 1))), 0.08 * pixel
        )

    def without_outliers(
        self, given: Reconstruction, most: float
    ) -> tuple[Problem, Reconstruction]:
        """The problem without sightings whose error is larger, and without points that are seen once."""
        good = np.linalg.norm(self.errors(given), axis=1) < most
        seen, points = self.seen.chosen(good, least=2)
        return Problem(seen, self._cameras), replace(given, points=given.points[points])

    def lowest(
        self, start: Reconstruction, cost: float, sigma: float
    ) -> tuple[Reconstruction, bool]:
        """The least cost along a profile over the focal length, between its steps, and whether it is an end of it."""
        ends = -np.log(np.tan(np.deg2rad([_WIDEST_DEG, _NARROWEST_DEG]) / 2))
        profile = [(float(start.lens[0]), cost, start)]
        for ratio in (_RATIO, 1.0 / _RATIO):
            each = start
            while ends[0] < each.lens[0] < ends[1]:
                each, cost = self.solved(each.stretched(ratio), BUT_FOCAL, sigma, 5)
                profile.append((float(each.lens[0]), cost, each))
                if cost > min(other for _, other, _ in profile) + _MOST_RISE:
                    break
        profile.sort(key=lambda step: step[0])
        costs = np.array([cost for _, cost, _ in profile])
        least = int(np.argmin(costs))
        best = profile[least][2]
        if least in (0, len(profile) - 1):
            return best, True
        low, middle, high = costs[least - 1 : least + 2]
        between = 0.5 * (low - high) / max(low - 2.0 * middle + high, 1e-12)
        return best.stretched(_RATIO ** float(np.clip(between, -1, 1))), False

    def solved(
        self, start: Reconstruction, first: int, sigma: float, iterations: int
    ) -> tuple[Reconstruction, float]:
        """Levenberg-Marquardt with the lens free from its ``first`` value on; also the robust cost."""
        cost, damping = self._cost(start, sigma), _FIRST_DAMPING
        for _ in range(iterations):
            system = self._system(start, first, sigma)
            gain, moved = 0.0, 0.0
            for _ in range(6):
                tried = self._stepped(start, system, first, damping)
                if tried is not None:
                    moved = abs(float(tried.lens[0] - start.lens[0]))
                    cost_tried = self._cost(tried, sigma)
                    if moved < _FARTHEST_STEP and cost_tried < cost:
                        gain, start, cost = (cost - cost_tried) / cost, tried, cost_tried
                        damping = max(0.1 * damping, _LEAST_DAMPING)
                        break
                damping = max(8.0 * damping, 1e-6)
            if gain < 1e-5 and (gain == 0 or moved < _SETTLED):
                break
        return start, cost

    def focal_sigma(self, given: Reconstruction, sigma: float) -> float:
        """Formal sigma of the logarithm of the focal length."""
        reduced, _, _ = _reduced(self._system(given, ALL, sigma), 1e-10)
        covariance = np.linalg.pinv(reduced, hermitian=True, rcond=1e-13)
        return float(np.sqrt(max(covariance[-5, -5], 0.0)))

    def _ideal(self, given: Reconstruction) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Images ``(S, 2)`` without lens, points in their cameras ``(S, 3)``, and whether before them ``(S,)``."""
        T, points = given.T_camera_world[self.seen.keyframe], given.points[self.seen.point]
        X = np.einsum("sij,sj->si", T[:, :3], points)
        z = np.maximum(X[:, 2:], 1e-9)
        return np.exp(given.lens[0]) * X[:, :2] / z, X, X[:, 2] > 1e-9

    def _squares(self, given: Reconstruction, sigma: float) -> FloatArray:
        squares = (self.errors(given) ** 2).sum(axis=1) / sigma**2
        return np.where(np.isfinite(squares), squares, 1e6)

    def _cost(self, given: Reconstruction, sigma: float) -> float:
        robust = _CAUCHY * np.log1p(self._squares(given, sigma) / _CAUCHY)
        return float(robust.sum() + (((given.lens - PRIOR) / _PRIOR_SIGMAS) ** 2).sum())

    def _system(self, given: Reconstruction, first: int, sigma: float) -> _System:
        """Normal equations of cameras but the first and the lens, of points, and between them."""
        seen, n = self.seen, 6 * (self._cameras - 1)
        ideal, X, before = self._ideal(given)
        image, by_ideal, by_lens = _bent(ideal, given.lens)
        weights = before / (1.0 + self._squares(given, sigma) / _CAUCHY) / sigma**2
        error = np.where(before[:, None], image - seen.image, 0.0)
        motion = pixel_jacobian(X, np.full(2, np.exp(given.lens[0]))).transpose(2, 1, 0)
        by_point_camera = by_ideal @ motion[:, :, 3:]
        homogeneous = given.points[seen.point, 3]
        by_camera = np.concatenate(
            [by_ideal @ motion[:, :, :3], by_point_camera * homogeneous[:, None, None]], axis=2
        )
        basis = _tangents(given.points)
        by_homogeneous = by_point_camera @ given.T_camera_world[seen.keyframe, :3]
        by_point = by_homogeneous @ basis[seen.point]
        by_lens = by_lens[:, :, first:]
        weighed = [each * weights[:, None, None] for each in (by_camera, by_point, by_lens)]
        A, B, C = (each.transpose(0, 2, 1) for each in weighed)
        own, side = np.zeros((n + by_lens.shape[2],) * 2), np.zeros(n + by_lens.shape[2])
        W = np.zeros((len(given.points), 3, len(side)))
        np.add.at(W[:, :, n:], seen.point, B @ by_lens)
        for k in range(1, self._cameras):
            rows, at = np.flatnonzero(seen.keyframe == k), slice(6 * (k - 1), 6 * k)
            own[at, at] = np.tensordot(A[rows], by_camera[rows], ([0, 2], [0, 1]))
            own[at, n:] = np.tensordot(A[rows], by_lens[rows], ([0, 2], [0, 1]))
            own[n:, at] = own[at, n:].T
            side[at] = np.tensordot(A[rows], error[rows], ([0, 2], [0, 1]))
            W[seen.point[rows], :, at] = B[rows] @ by_camera[rows]
        own[n:, n:] = np.tensordot(C, by_lens, ([0, 2], [0, 1])) + np.diag(
            _PRIOR_SIGMAS[first:] ** -2
        )
        from_prior = (given.lens - PRIOR)[first:] / _PRIOR_SIGMAS[first:] ** 2
        side[n:] = np.tensordot(C, error, ([0, 2], [0, 1])) + from_prior
        V, point_side = np.zeros((len(W), 3, 3)), np.zeros((len(W), 3))
        np.add.at(V, seen.point, B @ by_point)
        np.add.at(point_side, seen.point, (B @ error[:, :, None])[:, :, 0])
        return _System(own, side, V, point_side, W, basis)

    def _stepped(
        self, start: Reconstruction, system: _System, first: int, damping: float
    ) -> Reconstruction | None:
        reduced, side, inverse = _reduced(system, damping)
        try:
            step = cho_solve(cho_factor(reduced), -side)
        except (LinAlgError, ValueError):
            return None
        by_point = -np.einsum("pij,pj->pi", inverse, system.point_side + system.W @ step)
        n = 6 * (self._cameras - 1)
        moves = step[:n].reshape(-1, 6)
        T, lens = start.T_camera_world.copy(), start.lens.copy()
        T[1:] = compose(from_rotation_vector(moves[:, :3], moves[:, 3:]), T[1:])
        lens[first:] += step[n:]
        points = start.points + np.einsum("pij,pj->pi", system.basis, by_point)
        return Reconstruction(T, normalised(points), lens)


@dataclass(frozen=True)
class _System:
    """Blocks and right sides: ``own`` of cameras and lens, ``V`` of points; ``W`` ``(P, 3, n)`` between them."""

    own: FloatArray
    side: FloatArray
    V: FloatArray
    point_side: FloatArray
    W: FloatArray
    basis: FloatArray


def _reduced(system: _System, damping: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The system without the points, its right side, and the inverse of the points' blocks."""
    diagonal = np.einsum("pii->pi", system.V) * damping + 1e-12
    inverse = np.linalg.inv(system.V + diagonal[:, :, None] * np.eye(3))
    W = system.W.reshape(-1, system.W.shape[2])
    with_points = np.matmul(inverse, system.W).reshape(W.shape)
    own = system.own + np.diag(damping * np.diag(system.own) + 1e-9)
    side = system.side - with_points.T @ system.point_side.ravel()
    return own - with_points.T @ W, side, np.asarray(inverse)


def reconstructed(
    seen: Sightings, lens: FloatArray, pixel: float
) -> tuple[Problem, Reconstruction] | None:
    """Structure from motion by a lens that is known: two keyframes, then one after the other."""
    count, focal_px = int(seen.keyframe.max(initial=-1)) + 1, float(np.exp(lens[0])) / pixel
    rays = np.column_stack([seen.image * np.exp(-lens[0]), np.ones(len(seen))])
    at = np.full((count, int(seen.point.max(initial=-1)) + 1), -1)
    at[seen.keyframe, seen.point] = np.arange(len(seen))
    if count < LEAST_KEYFRAMES:
        return None
    shared = ((at >= 0) & (at[0] >= 0)).sum(axis=1)
    far = np.flatnonzero(shared[1:] >= max(50, 0.35 * shared[0])) + 1
    if not len(far):
        return None
    second = int(far[-1])
    both = (at[0] >= 0) & (at[second] >= 0)
    motion = unit_pose_by_essential(rays[at[0, both]], rays[at[second, both]], 1.5 / focal_px)
    if motion is None:
        return None
    T = np.full((count, 4, 4), np.nan)
    T[0], T[second] = np.eye(4), make(motion.R_current_previous, motion.direction)
    K = np.diag([focal_px, focal_px, 1.0])
    for n, k in enumerate([*range(1, second), *range(second + 1, count)]):
        points = _triangulated(seen, rays, T, focal_px)
        rows = np.flatnonzero((seen.keyframe == k) & np.isfinite(points[seen.point, 0]))
        if len(rows) < 12:
            break
        known = points[seen.point[rows]]
        near = min(np.flatnonzero(np.isfinite(T[:, 0, 0])).tolist(), key=lambda j: abs(j - k))
        X = known[:, :3] / np.maximum(np.abs(known[:, 3:]), 1e-3)
        pose = resect([T[near]], X, rays[rows, :2] * focal_px, K)
        if len(pose.inliers) < max(10, 0.3 * len(rows)):
            if k > second:
                break
            continue
        T[k] = pose.T_camera_world
        if n % 3 == 2:
            solved = _adjusted(seen, rays, T, lens, pixel, 4)
            T[np.isfinite(T[:, 0, 0])] = solved[1].T_camera_world
    if np.isfinite(T[:, 0, 0]).sum() < LEAST_KEYFRAMES:
        return None
    problem, found = _adjusted(seen, rays, T, lens, pixel, 6)
    return (problem, found) if len(problem.seen) > 0.7 * len(seen) else None


def _adjusted(
    seen: Sightings,
    rays: FloatArray,
    T: FloatArray,
    lens: FloatArray,
    pixel: float,
    iterations: int,
) -> tuple[Problem, Reconstruction]:
    """Of the cameras that are known, with the points that they see."""
    points = _triangulated(seen, rays, T, float(np.exp(lens[0])) / pixel)
    known = np.isfinite(T[:, 0, 0])
    rows = known[seen.keyframe] & np.isfinite(points[seen.point, 0])
    part, kept = seen.chosen(rows, least=2)
    part = replace(part, keyframe=(np.cumsum(known) - 1)[part.keyframe])
    problem = Problem(part, int(known.sum()))
    start = Reconstruction(T[known], points[kept], lens)
    return problem, problem.solved(start, NOTHING, 0.7 * pixel, iterations)[0]


def _triangulated(seen: Sightings, rays: FloatArray, T: FloatArray, focal_px: float) -> FloatArray:
    """Homogeneous points ``(P, 4)`` of the known cameras, NaN where they are no point before them."""
    rows = np.flatnonzero(np.isfinite(T[seen.keyframe, 0, 0]))
    point, P = seen.point[rows], T[seen.keyframe[rows], :3]
    lines = rays[rows, :2, None] * P[:, 2:] - P[:, :2]
    count = int(seen.point.max()) + 1
    normal = np.zeros((count, 4, 4))
    np.add.at(normal, point, lines.transpose(0, 2, 1) @ lines)
    points = np.linalg.eigh(normal)[1][:, :, 0]
    X = np.einsum("sij,sj->si", P, points[point])
    backwards = np.bincount(point, np.sign(X[:, 2]), count) < 0
    points[backwards] *= -1.0
    X[backwards[point]] *= -1.0
    error = np.linalg.norm(X[:, :2] / np.maximum(X[:, 2:], 1e-9) - rays[rows, :2], axis=1)
    wrong = np.bincount(point, (X[:, 2] <= 0) | (error * focal_px > 6.0), count) > 0
    points[wrong | (np.bincount(point, minlength=count) < 2)] = np.nan
    return points


def _bent(ideal: FloatArray, lens: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Images ``(S, 2)`` through the lens; derivatives by those without ``(S, 2, 2)`` and by the lens ``(S, 2, 5)``."""
    square = (ideal**2).sum(axis=1)[:, None]
    factor = 1.0 + lens[1] * square + lens[2] * square**2
    slope = 2.0 * lens[1] + 4.0 * lens[2] * square
    by_ideal = (
        factor[:, :, None] * np.eye(2) + slope[:, :, None] * ideal[:, :, None] * ideal[:, None]
    )
    by_focal = ideal * (factor + slope * square)
    by_centre = np.broadcast_to(np.eye(2), by_ideal.shape)
    radial = np.stack([by_focal, ideal * square, ideal * square**2], axis=2)
    return ideal * factor + lens[3:], by_ideal, np.concatenate([radial, by_centre], axis=2)


def _tangents(points: FloatArray) -> FloatArray:
    """Three directions ``(P, 4, 3)`` across each homogeneous point: columns of Householder's reflection."""
    across = points.copy()
    across[:, 3] += np.where(points[:, 3] >= 0, 1.0, -1.0)
    square = (across**2).sum(axis=1)[:, None, None]
    return np.asarray((np.eye(4) - 2.0 * across[:, :, None] * across[:, None] / square)[:, :, :3])


def normalised(vectors: FloatArray) -> FloatArray:
    """Vectors ``(N, D)`` of length one."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
