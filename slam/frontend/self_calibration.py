"""The camera of a recording that nobody calibrated: focal length, lens and principal point, where it turns.

Corners of the first images are followed from keyframe to keyframe. Each window of keyframes is reconstructed at one
guessed focal length, from keyframes that turn on the spot, and then at others along the direction that driving straight on cannot see: lengths along the
axis grow as the focal length, turns shrink. From the lowest cost of this profile a bundle adjustment frees the focal
length, two radial coefficients and the principal point. From one guess it would not converge. Windows are joined
robustly, with sigmas as measured on recordings with a calibration (``docs/own-camera.md``).

Images are measured in half their width from their middle, so that nothing here knows their size; the lens then does
not move with the focal length.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from erfsfm.common.processes import limit_library_threads
from erfsfm.common.readers.camera_file import UNKNOWN_FOV_DEG, UNKNOWN_FX_SIGMA, CameraFile
from slam.frames import Frame
from slam.frontend.tracking import Search, Texture, are_inside, new_corners, track
from slam.geometry.multiview import pixel_jacobian, rotation_between
from slam.geometry.robust import mad_sigma, median, weighted_median
from slam.geometry.se3 import FloatArray, compose, from_rotation_vector, invert, make

MOST_FRAMES = 450
SURE, ROUGH = 0.05, 0.12  # relative sigmas below which a focal length is found, or roughly
_WIDTH_PX = 960  # of the images that are followed
# corners of plain walls creep, and windows beyond the border slip: both bend the focal length by 3 %
_SEARCH = Search(
    side=16, levels=4, limits=(20, 0.02), back=None, error_px=0.5, norm=np.inf, texture=1e-4
)
_BORDER_PX = 8.0
_TEXTURE = Texture(quality=0.01, spacing_px=10.0, block_px=5)
_CORNERS = 500
_MOVED = 0.06  # of half the width, from keyframe to keyframe
_LOST = 0.5  # of the corners of the last keyframe
_KEYFRAMES, _WINDOWS, _LEAST_KEYFRAMES = 20, 6, 4
_LEAST_SIGHTINGS = 600  # of a window that counts
# logarithm of the focal length, both radial coefficients, principal point
_PRIOR = np.array([-np.log(np.tan(np.deg2rad(UNKNOWN_FOV_DEG) / 2)), 0.0, 0.0, 0.0, 0.0])
_PRIOR_SIGMAS = np.array([0.5, 0.15, 0.05, 0.024, 0.024])
_ALL, _BUT_FOCAL, _NOTHING = 0, 1, 5  # the first of these that is free
_FEW, _MANY = 5, 25  # iterations
# where all keyframes turn on the spot: sigmas of sightings, one after the other, how far keyframes lie apart, and 1 over
# the distance of the points
_FIRST_SIGMAS_PX, _APART, _NEARNESS = (2.0, 0.7), 1e-3, 0.1
_LEAST_SHARED = 15  # corners of a keyframe and the one before
_WIDEST_DEG, _NARROWEST_DEG = 125.0, 32.0  # ends of a profile
_RATIO, _MOST_RISE = 1.15, 30.0  # of its steps, and of its cost above the least
_CAUCHY = 4.0  # squared sigmas
_FIRST_DAMPING, _LEAST_DAMPING = 1e-4, 1e-11
_FARTHEST_STEP, _SETTLED = 0.4, 0.002  # of the logarithm of the focal length
_TURNING = 0.5  # radians beyond which turns are told without the focal length
# the formal sigma of a window is several times too small, and rectified images keep an error of their lens
_INFLATED, _FLOOR, _SYSTEMATIC = 3.0, 0.03, 0.02
_HUBER = 1.5


@dataclass(frozen=True)
class FoundCamera:
    """A camera by its own images: ``focal`` and, from the middle, ``centre`` in half widths; ``radial`` k1 and k2.

    ``sigma`` is relative, of the focal length; ``turn_deg`` the largest turn of the axis in one of
    the ``windows`` that tell.
    """

    focal: float
    radial: tuple[float, float]
    centre: tuple[float, float]
    sigma: float
    windows: int
    turn_deg: float

    def as_file(self, guess: CameraFile, source: str) -> CameraFile:
        """The camera file in place of a ``guess``, whose size, rate and height hold."""
        half = guess.width / 2
        keys: dict[str, Any] = {
            "fx": round(self.focal * half, 2),
            "fy": round(self.focal * half, 2),
            "cx": round(guess.cx + self.centre[0] * half, 2),
            "cy": round(guess.cy + self.centre[1] * half, 2),
        }
        if any(self.radial):
            first, second = (round(value, 5) for value in self.radial)
            keys |= {"model": "opencv", "distortion": (first, second, 0.0, 0.0)}
        return guess.model_copy(update=keys | {"fx_sigma": round(self.sigma, 4), "source": source})

    def sentence(self, width: int) -> str:
        """What the user is told of it, for images of this width in pixels."""
        fov_deg = 2.0 * np.rad2deg(np.arctan(1.0 / self.focal))
        if self.sigma > ROUGH:
            return (
                "the focal length cannot be seen: the camera does not turn; lengths along the road may be wrong by a "
                f"third: turn it once, state fov= or give GPS; fov={fov_deg:.0f} is taken"
            )
        roughly = ", roughly" if self.sigma > SURE else ""
        windows = (
            "1 window that turns" if self.windows == 1 else f"{self.windows} windows that turn"
        )
        return (
            f"the focal length is {self.focal * width / 2:.0f} px ± {100 * self.sigma:.1f} % (fov={fov_deg:.0f})"
            f"{roughly}, found from {windows} by up to {self.turn_deg:.0f} degrees"
        )


def find_camera(frames: Iterable[Frame]) -> FoundCamera:
    """The camera of images of one size, in their order; the prior's with its sigma where it cannot be seen."""
    with limit_library_threads():  # the systems are small
        seen, pixel = follow(frames)
        windows = [calibrated(part, pixel) for part in windows_that_turn(seen)]
    return joined(window for window in windows if window is not None)


@dataclass(frozen=True)
class Sightings:
    """``S`` sightings: rows of keyframes and points ``(S,)``, ``image`` ``(S, 2)`` in half widths from the middle."""

    keyframe: NDArray[np.int64]
    point: NDArray[np.int64]
    image: FloatArray

    def __len__(self) -> int:
        return len(self.keyframe)

    def shared(self, keyframe: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of the points that the keyframe before shows as well, in that and in this one."""
        before = np.flatnonzero(self.keyframe == keyframe - 1)
        own = np.flatnonzero(self.keyframe == keyframe)
        _, first, second = np.intersect1d(self.point[before], self.point[own], return_indices=True)
        return before[first], own[second]

    def chosen(self, rows: NDArray[Any], least: int) -> tuple[Sightings, NDArray[np.int64]]:
        """Those of points that keep so many, numbered anew, and the points that are kept."""
        keyframe, point, image = self.keyframe[rows], self.point[rows], self.image[rows]
        often = np.bincount(point)[point] >= least
        points, numbers = np.unique(point[often], return_inverse=True)
        return Sightings(keyframe[often], numbers, image[often]), points


@dataclass(frozen=True)
class Reconstruction:
    """``T_camera_world`` ``(K, 4, 4)``, the first the identity; homogeneous ``points`` ``(P, 4)``; ``lens`` ``(5,)``."""

    T_camera_world: FloatArray
    points: FloatArray
    lens: FloatArray

    @property
    def turns(self) -> FloatArray:
        """Rotation vectors of the cameras ``(K, 3)``."""
        return np.asarray(Rotation.from_matrix(self.T_camera_world[:, :3, :3]).as_rotvec())

    def stretched(self, ratio: float) -> Reconstruction:
        """The same images under a focal length so many times as long, to first order in the turns."""
        points = _normalised(self.points * [1.0, 1.0, ratio, 1.0])
        T_world_camera = invert(self.T_camera_world)
        turns = self.turns.copy()
        aside = np.maximum(np.linalg.norm(turns[:, :2], axis=1), 1e-9)
        shrunk = np.where(aside < _TURNING, np.arctan(np.tan(aside) / ratio) / aside, 1.0)
        turns[:, :2] *= shrunk[:, None]
        R = Rotation.from_rotvec(turns).as_matrix()
        centres = T_world_camera[:, :3, 3] * [1.0, 1.0, ratio]
        T_camera_world = make(R, -np.einsum("kij,kj->ki", R, centres))
        return Reconstruction(
            T_camera_world, points, self.lens + np.log(ratio) * (np.arange(5) == 0)
        )


class Window(NamedTuple):
    """What one window says: ``lens`` ``(5,)``, ``sigma`` of the first, and the largest turn of its axis."""

    lens: FloatArray
    sigma: float
    sightings: int
    turn_deg: float
    at_end: bool


def follow(frames: Iterable[Frame]) -> tuple[Sightings, float]:
    """Sightings of corners in the keyframes of some frames, and the size of a pixel in half widths."""
    rows: list[FloatArray] = []
    pixels, ids = np.zeros((0, 2), np.float32), np.zeros(0, np.int64)
    last, last_ids, sought, width, before = pixels, ids, 0, 1, None
    for frame in frames:
        frame = _narrow(frame)
        height, width = frame.grey.shape
        if before is not None:
            pixels, kept = track(before, frame.grey, pixels, _SEARCH)
            inner = height - 2 * _BORDER_PX, width - 2 * _BORDER_PX
            kept &= are_inside(pixels - _BORDER_PX, inner)
            pixels, ids = pixels[kept], ids[kept]
        before = frame.grey
        _, own, at_last = np.intersect1d(ids, last_ids, return_indices=True)
        moved = np.linalg.norm(pixels[own] - last[at_last], axis=1)
        if len(own) > _LOST * len(last_ids) and median(moved) < _MOVED * width / 2:
            continue
        corners = new_corners(frame, pixels, _CORNERS - len(pixels), _TEXTURE)
        pixels = np.concatenate([pixels, corners])
        ids = np.concatenate([ids, sought + np.arange(len(corners))])
        sought += len(corners)
        last, last_ids = pixels, ids
        image = (pixels - [(width - 1) / 2, (height - 1) / 2]) * (2.0 / width)
        rows.append(np.column_stack([np.full(len(ids), len(rows)), ids, image]))
    table = np.concatenate(rows) if rows else np.zeros((0, 4))
    return Sightings(
        table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2:]
    ), 2.0 / width


def windows_that_turn(seen: Sightings) -> list[Sightings]:
    """The windows of keyframes whose images go furthest aside, at most six, the first keyframe of each its row 0."""
    keyframes = int(seen.keyframe.max(initial=-1)) + 1
    aside = np.zeros((keyframes, 2))
    for k in range(1, keyframes):
        before, own = seen.shared(k)
        moved = seen.image[own] - seen.image[before]
        aside[k] = aside[k - 1] + (np.median(moved, axis=0) if len(moved) else 0.0)
    count = min(_KEYFRAMES, keyframes)
    starts = range(0, keyframes - count + 1, _KEYFRAMES // 2)
    turns = [
        float(np.ptp(aside[start : start + count], axis=0).max(initial=0.0)) for start in starts
    ]
    windows = []
    for n in np.argsort(turns)[::-1][:_WINDOWS].tolist():
        rows = np.flatnonzero((seen.keyframe >= starts[n]) & (seen.keyframe < starts[n] + count))
        part, _ = seen.chosen(rows, least=3)
        windows.append(replace(part, keyframe=part.keyframe - starts[n]))
    return windows


def calibrated(seen: Sightings, pixel: float) -> Window | None:
    """What a window says of its camera; ``pixel`` is its size in half widths. None where keyframes share too little."""
    started = _turning(seen, pixel)
    if started is None:
        return None
    problem, start = started
    start, _ = problem.solved(start, _BUT_FOCAL, 0.5 * pixel, _FEW)
    problem, start = problem.without_outliers(start, 8.0, pixel)
    for _ in range(2):
        start, cost = problem.solved(start, _BUT_FOCAL, problem.spread(start, pixel), _FEW)
    sigma = problem.spread(start, pixel)
    start, at_end = problem.lowest(start, sigma)
    for _ in range(3):
        start, _ = problem.solved(start, _ALL, sigma, _MANY)
        problem, start = problem.without_outliers(start, 5.0, pixel)
        sigma = problem.spread(start, pixel)
    start, _ = problem.solved(start, _ALL, sigma, _MANY)
    return Window(
        start.lens,
        problem.focal_sigma(start, sigma),
        len(problem.seen),
        float(np.rad2deg(np.linalg.norm(start.turns[:, :2], axis=1).max())),
        at_end,
    )


def joined(windows: Iterable[Window]) -> FoundCamera:
    """The camera by windows, robustly, and a prior of its focal length; the prior's alone where they say too little."""
    telling = [w for w in windows if w.sightings > _LEAST_SIGHTINGS and not w.at_end]
    values = np.array([*(window.lens[0] for window in telling), _PRIOR[0]])
    own_sigmas = [np.hypot(_INFLATED * window.sigma, _FLOOR) for window in telling]
    sigmas = np.array([*own_sigmas, UNKNOWN_FX_SIGMA])
    centre = weighted_median(values, sigmas**-2)
    for _ in range(10):
        near = np.maximum(np.abs(values - centre) / sigmas, 1e-9)
        weights = np.minimum(1.0, _HUBER / near) / sigmas**2
        centre = float(weights @ values / weights.sum())
    disagree = float(weights @ (values - centre) ** 2) / max(len(telling), 1)
    sigma = float(np.hypot(np.sqrt(max(1.0, disagree) / weights.sum()), _SYSTEMATIC))
    if not telling or sigma > ROUGH:
        focal = float(np.exp(_PRIOR[0]))
        return FoundCamera(focal, (0.0, 0.0), (0.0, 0.0), UNKNOWN_FX_SIGMA, 0, 0.0)
    focal, own = float(np.exp(centre)), weights[:-1]
    first, second, x, y = (own @ np.array([w.lens[1:] for w in telling]) / own.sum()).tolist()
    turn_deg = max(window.turn_deg for window in telling)
    radial = first * focal**2, second * focal**4
    return FoundCamera(focal, radial, (x, y), sigma, len(telling), turn_deg)


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
        return max(mad_sigma(self.errors(given)) * np.sqrt(count / max(freedom, 1)), 0.08 * pixel)

    def without_outliers(
        self, given: Reconstruction, sigmas: float, pixel: float
    ) -> tuple[Problem, Reconstruction]:
        """The problem without sightings whose error is of more sigmas, and without points that are then seen once."""
        most = max(sigmas * self.spread(given, pixel), 0.4 * pixel)
        good = np.linalg.norm(self.errors(given), axis=1) < most
        seen, points = self.seen.chosen(good, least=2)
        return Problem(seen, self._cameras), replace(given, points=given.points[points])

    def lowest(self, start: Reconstruction, sigma: float) -> tuple[Reconstruction, bool]:
        """The least cost along a profile over the focal length, between its steps, and whether it is an end of it."""
        ends = -np.log(np.tan(np.deg2rad([_WIDEST_DEG, _NARROWEST_DEG]) / 2))
        profile = [(float(start.lens[0]), self._cost(start, sigma), start)]
        for ratio in (_RATIO, 1.0 / _RATIO):
            each = start
            while ends[0] < each.lens[0] < ends[1]:
                each, cost = self.solved(each.stretched(ratio), _BUT_FOCAL, sigma, _FEW)
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
        reduced, _, _ = _reduced(self._system(given, _ALL, sigma), 1e-10)
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
        return float(robust.sum() + (((given.lens - _PRIOR) / _PRIOR_SIGMAS) ** 2).sum())

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
        from_prior = (given.lens - _PRIOR)[first:] / _PRIOR_SIGMAS[first:] ** 2
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
        return Reconstruction(T, _normalised(points), lens)


class _System(NamedTuple):
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


def _turning(seen: Sightings, pixel: float) -> tuple[Problem, Reconstruction] | None:
    """A start by the usual lens: the keyframes turn on the spot, as far as they share corners, and points are far away."""
    rays = np.column_stack([seen.image * np.exp(-_PRIOR[0]), np.ones(len(seen))])
    R = [np.eye(3)]
    for k in range(1, int(seen.keyframe.max(initial=-1)) + 1):
        before, own = seen.shared(k)
        if len(own) < _LEAST_SHARED:
            break
        R.append(compose(rotation_between(rays[before], rays[own]), R[-1]))
    if len(R) < _LEAST_KEYFRAMES:
        return None
    R_camera_world, rows = np.array(R), seen.keyframe < len(R)
    part, points = seen.chosen(rows, least=2)
    rays = _normalised(rays[rows & np.isin(seen.point, points)])
    directions = np.zeros((len(points), 4))
    in_world = np.einsum("sji,sj->si", R_camera_world[part.keyframe], rays)
    np.add.at(directions[:, :3], part.point, in_world)
    directions = _normalised(directions)
    directions[:, 3] = _NEARNESS
    places = _APART * np.random.default_rng(0).normal(size=(len(R), 3))
    start = Reconstruction(make(R_camera_world, places), _normalised(directions), _PRIOR)
    problem = Problem(part, len(R))
    for sigma in _FIRST_SIGMAS_PX:
        start, _ = problem.solved(start, _NOTHING, sigma * pixel, _MANY)
    return problem, start


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


def _normalised(vectors: FloatArray) -> FloatArray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _narrow(frame: Frame) -> Frame:
    """The same image, at most so wide that following its corners is quick."""
    height, width = frame.image.shape[:2]
    if width <= _WIDTH_PX:
        return frame
    size = _WIDTH_PX, round(height * _WIDTH_PX / width)
    small = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
    return Frame(frame.index, frame.stamp, np.asarray(small, np.uint8), frame.fixed)
