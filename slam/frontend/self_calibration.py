"""The camera of a recording that nobody calibrated: focal length, lens and principal point, where it turns.

Corners of the first images are followed from keyframe to keyframe. Each window of keyframes is reconstructed at one
guessed focal length, beginning with keyframes that turn on the spot, and then at others, along the direction that
driving straight on cannot see: lengths along the axis grow as the focal length, turns shrink. From the lowest cost of
this profile a bundle adjustment frees the focal length, two radial coefficients and the principal point. From one guess
it would not converge. Windows are joined robustly, with sigmas as measured on recordings with a calibration
(``docs/own-camera.md``).

Images are measured in half their width from their middle, so that nothing here knows their size; the lens then does
not move with the focal length.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, block_diag, cho_factor, cho_solve
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from erfsfm.common.processes import limit_library_threads
from erfsfm.common.readers.camera_file import UNKNOWN_FOV_DEG, UNKNOWN_FX_SIGMA, CameraFile
from slam.frames import Frame, Intrinsics
from slam.frontend.followed_corners import FollowedCorners, follow
from slam.geometry.multiview import LEAST_DEPTH, pixel_jacobian, rotation_between
from slam.geometry.robust import mad_sigma, weighted_median
from slam.geometry.se3 import FloatArray, compose, from_rotation_vector, invert, make, normalised

MOST_FRAMES = 450
SURE, ROUGH = 0.05, 0.12  # relative sigmas below which a focal length is found, or roughly
_KEYFRAMES, _WINDOWS, _LEAST_KEYFRAMES = 20, 6, 4
_LEAST_SIGHTINGS = 600  # of a window that counts
# logarithm of the focal length, both radial coefficients, principal point
_PRIOR = np.array([-np.log(np.tan(np.deg2rad(UNKNOWN_FOV_DEG) / 2)), 0.0, 0.0, 0.0, 0.0])
_PRIOR_SIGMAS = np.array([0.5, 0.15, 0.05, 0.024, 0.024])
_MOST_ODD = 5.0  # prior sigmas of a lens or principal point: what is beyond is a false minimum
_ALL, _BUT_FOCAL, _NOTHING = 0, 1, 5  # the first of these that is free
_FEW, _MANY = 5, 25  # iterations
# where all keyframes turn on the spot: sigmas of sightings, one after the other, how far keyframes lie apart, and 1
# over the distance of the points
_FIRST_SIGMAS_PX, _APART, _NEARNESS = (2.0, 0.7), 1e-3, 0.1
_LEAST_SHARED = 15  # corners of a keyframe and the one before
_WIDEST_DEG, _NARROWEST_DEG = 125.0, 32.0  # ends of a profile
_RATIO, _MOST_RISE = 1.15, 30.0  # of its steps, and of its cost above the least
_CAUCHY = 4.0  # squared sigmas
_FIRST_DAMPING, _LEAST_DAMPING = 1e-4, 1e-11
_TRIALS, _LEAST_GAIN = 6, 1e-5  # of a step, and of the cost
_TURNING = 0.5  # radians beyond which turns are told without the focal length
# the formal sigma of a window is several times too small, and rectified images keep an error of their lens
_INFLATED, _FLOOR, _SYSTEMATIC = 3.0, 0.03, 0.02
_BY_TURN = 0.3  # sigma of a window that turns by one degree; less, as it turns more
_HUBER = 1.5
# of a stated camera: every how many keyframes of a window, and points in these, which take 3 % of the shortest run with
# a map that is checked, by keyframes (90 in 300 frames of a street); sigmas beyond which a second window is asked
_EVERY, _CHECKED, _LEAST_CHECKED, _DOUBTFUL = 2, 240, 60, 1.5


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
        focal, cx, cy = (round(half * value, 2) for value in (self.focal, *self.centre))
        keys = {
            "fx": focal,
            "fy": focal,
            "cx": guess.cx + cx,
            "cy": guess.cy + cy,
            "model": "opencv",
            "distortion": (*(round(value, 5) for value in self.radial), 0.0, 0.0),
            "fx_sigma": round(self.sigma, 4),
            "source": source,
        }
        return guess.model_copy(update=keys)

    def sigmas_from(self, stated: Intrinsics) -> float:
        """How far the focal length of another camera is from the one found; 0 where none is."""
        if self.sigma > ROUGH:
            return 0.0
        ratio = self.focal / stated.focal_half_widths
        return abs(math.log(ratio)) / math.hypot(self.sigma, stated.focal_sigma)

    def sentence(self, width: int) -> str:
        """What the user is told of it, for images of this width in pixels."""
        fov_deg = 2.0 * np.rad2deg(np.arctan(1.0 / self.focal))
        if self.sigma > ROUGH:
            return (
                "the focal length cannot be seen: the camera does not turn; lengths along the road may be wrong by a "
                f"third: turn it once, state fov= or give GPS; fov={fov_deg:.0f} is taken"
            )
        roughly = ", roughly" if self.sigma > SURE else ""
        return (
            f"the focal length is {self.focal * width / 2:.0f} px ± {100 * self.sigma:.1f} % (fov={fov_deg:.0f})"
            f"{roughly}, found from {self.windows} windows that turn by up to {self.turn_deg:.0f} degrees"
        )


def find_camera(frames: Iterable[Frame]) -> FoundCamera:
    """The camera of images of one size, in their order; the prior's with its sigma where it cannot be seen."""
    with limit_library_threads():  # the systems are small
        return joined(map(calibrated, windows_that_turn(follow(frames))))


def check_camera(seen: FollowedCorners, stated: Intrinsics) -> FoundCamera:
    """The camera by the corners that a drive followed, measured from the principal point of the ``stated`` one.

    Every second keyframe of one window is asked, and where it is in doubt of the next one, if the drive is long enough
    to pay for it. With fewer points of all keyframes a window ends in false minima.
    """
    told: list[Window | None] = []
    found = joined(told)
    if seen.keyframe.max(initial=0) < _LEAST_CHECKED:
        return found
    for window in windows_that_turn(seen)[:2]:
        part, _ = window.chosen(window.keyframe % _EVERY == 0, least=2)
        part = replace(part, keyframe=part.keyframe // _EVERY)
        longest = np.argsort(-np.bincount(part.point), kind="stable")[:_CHECKED]
        told.append(calibrated(part.chosen(np.isin(part.point, longest), least=2)[0], _FEW))
        found = joined(told)
        if found.sigmas_from(stated) < _DOUBTFUL:
            break
    return found


@dataclass(frozen=True)
class Reconstruction:
    """``T_camera_world`` ``(K, 4, 4)``, first the identity; homogeneous ``points`` ``(P, 4)``; ``lens`` ``(5,)``."""

    T_camera_world: FloatArray
    points: FloatArray
    lens: FloatArray

    @property
    def turns(self) -> FloatArray:
        """Rotation vectors of the cameras ``(K, 3)``."""
        return Rotation.from_matrix(self.T_camera_world[:, :3, :3]).as_rotvec()

    def stretched(self, ratio: float) -> Reconstruction:
        """The same images under a focal length so many times as long, to first order in the turns."""
        points = normalised(self.points * [1.0, 1.0, ratio, 1.0])
        centres = invert(self.T_camera_world)[:, :3, 3] * [1.0, 1.0, ratio]
        turns = self.turns
        aside = np.maximum(np.linalg.norm(turns[:, :2], axis=1), 1e-9)
        shrunk = np.where(aside < _TURNING, np.arctan(np.tan(aside) / ratio) / aside, 1.0)
        turns[:, :2] *= shrunk[:, None]
        R = Rotation.from_rotvec(turns).as_matrix()
        lens = self.lens + math.log(ratio) * np.eye(5)[0]
        return Reconstruction(make(R, -np.einsum("kij,kj->ki", R, centres)), points, lens)


class Window(NamedTuple):
    """What one window says: ``lens`` ``(5,)`` with its ``sigmas`` ``(5,)``, and the largest turn of its axis.

    A window that does not turn says nothing of the focal length, whose sigma is infinite, but knows
    how the lens bends the paths of its points.
    """

    lens: FloatArray
    sigmas: FloatArray
    turn_deg: float


def windows_that_turn(seen: FollowedCorners) -> list[FollowedCorners]:
    """The windows of keyframes whose images go furthest aside, at most six, the first keyframe of each its row 0."""
    keyframes = int(seen.keyframe.max(initial=-1)) + 1
    aside = np.zeros((keyframes, 2))
    for k in range(1, keyframes):
        before, own = seen.shared(k)
        moved = seen.image[own] - seen.image[before]
        aside[k] = aside[k - 1] + (np.median(moved, axis=0) if len(moved) else 0.0)
    count = min(_KEYFRAMES, keyframes)
    starts = range(0, keyframes - count + 1, _KEYFRAMES // 2)
    turns = [np.ptp(aside[start : start + count], axis=0).max() for start in starts if count]
    windows = []
    for n in np.argsort(turns)[::-1][:_WINDOWS].tolist():
        part, _ = seen.chosen((seen.keyframe - starts[n]) // count == 0, least=3)
        windows.append(replace(part, keyframe=part.keyframe - starts[n]))
    return windows


def calibrated(seen: FollowedCorners, iterations: int = _MANY) -> Window | None:
    """What a window says of its camera, so many ``iterations`` between outliers; None where it tells nothing."""
    if (started := _turning(seen)) is None:
        return None
    problem, start = started
    start = problem.solved(start, _BUT_FOCAL, 0.5 * seen.pixel, _FEW)
    problem, start = problem.without_outliers(start, 8.0)
    for _ in range(2):
        sigma = problem.spread(start)
        start = problem.solved(start, _BUT_FOCAL, sigma, _FEW)
    lowest = problem.lowest(start, sigma)
    free = _BUT_FOCAL if lowest is None else _ALL
    start = lowest or start
    for _ in range(3):
        start = problem.solved(start, free, sigma, iterations)
        problem, start = problem.without_outliers(start, 5.0)
        sigma = problem.spread(start)
    start = problem.solved(start, free, sigma, _MANY)
    is_odd = np.abs(start.lens - _PRIOR)[1:] > _MOST_ODD * _PRIOR_SIGMAS[1:]
    if len(problem.seen) < _LEAST_SIGHTINGS or is_odd.any():
        return None
    turn = np.linalg.norm(start.turns[:, :2], axis=1).max() + 1e-9
    sigmas = problem.lens_sigmas(start, free, sigma)
    return Window(start.lens, _INFLATED * sigmas, float(np.rad2deg(turn)))


def joined(windows: Iterable[Window | None]) -> FoundCamera:
    """The camera by windows, robustly, and a prior; the prior's focal length alone where they say too little."""
    telling = [window for window in windows if window is not None]
    lenses = np.array([*(window.lens for window in telling), _PRIOR])
    doubts = [math.hypot(w.sigmas[0], _FLOOR, _BY_TURN / w.turn_deg) for w in telling]
    values, sigmas = lenses[:, 0], np.array([*doubts, UNKNOWN_FX_SIGMA])
    centre = weighted_median(values, sigmas**-2)
    for _ in range(10):
        near = np.maximum(np.abs(values - centre) / sigmas, 1e-9)
        weights = np.minimum(1.0, _HUBER / near) / sigmas**2
        centre = float(weights @ values / weights.sum())
    disagree = float(weights @ (values - centre) ** 2) / len(values)
    sigma = float(np.hypot(np.sqrt(max(1.0, disagree) / weights.sum()), _SYSTEMATIC))
    if sigma > ROUGH:
        sigma = UNKNOWN_FX_SIGMA
        weights = np.array([*(w.sigmas[1] for w in telling), _PRIOR_SIGMAS[1]]) ** -2
        lens = _PRIOR + [0, 1, 1, 0, 0] * (weights @ lenses / weights.sum())
    else:
        lens = weights @ lenses / weights.sum()
    log_focal, first, second, x, y = lens.tolist()
    focal = math.exp(log_focal)
    seen = [window.turn_deg for window in telling if np.isfinite(window.sigmas[0])]
    radial = first * focal**2, second * focal**4
    return FoundCamera(focal, radial, (x, y), sigma, len(seen), max(seen, default=0.0))


class Problem:
    """Bundle adjustment of one window: cameras, homogeneous points and the lens that they share."""

    def __init__(self, seen: FollowedCorners) -> None:
        self.seen = seen

    def errors(self, given: Reconstruction) -> FloatArray:
        """Of the image of each sighting ``(S, 2)``; huge behind the camera."""
        return _bent(self._ideal(given)[0], given.lens)[0] - self.seen.image

    def spread(self, given: Reconstruction) -> float:
        """Sigma of a coordinate of a sighting."""
        count = 2 * len(self.seen)
        freedom = count - 6 * (len(given.T_camera_world) - 1) - 3 * len(given.points)
        inflated = math.sqrt(count / max(freedom, 1))
        return max(mad_sigma(self.errors(given)) * inflated, 0.08 * self.seen.pixel)

    def without_outliers(
        self, given: Reconstruction, sigmas: float
    ) -> tuple[Problem, Reconstruction]:
        """The problem without sightings whose error is of more sigmas, and without points that are then seen once."""
        most = max(sigmas * self.spread(given), 0.4 * self.seen.pixel)
        good = np.linalg.norm(self.errors(given), axis=1) < most
        seen, points = self.seen.chosen(good, least=2)
        return Problem(seen), replace(given, points=given.points[points])

    def lowest(self, start: Reconstruction, sigma: float) -> Reconstruction | None:
        """The least cost along a profile over the focal length; None where it is an end of it."""
        ends = -np.log(np.tan(np.deg2rad([_WIDEST_DEG, _NARROWEST_DEG]) / 2))
        profile = [(self._cost(start, sigma), start)]
        for ratio in (_RATIO, 1.0 / _RATIO):
            each = start
            while ends[0] < each.lens[0] < ends[1]:
                each = self.solved(each.stretched(ratio), _BUT_FOCAL, sigma, _FEW)
                cost = self._cost(each, sigma)
                profile.append((cost, each))
                if cost > min(other for other, _ in profile) + _MOST_RISE:
                    break
        profile.sort(key=lambda step: step[1].lens[0])
        least = int(np.argmin([cost for cost, _ in profile]))
        return profile[least][1] if 0 < least < len(profile) - 1 else None

    def solved(
        self, start: Reconstruction, first: int, sigma: float, iterations: int
    ) -> Reconstruction:
        """Levenberg-Marquardt with the lens free from its ``first`` value on."""
        cost, damping = self._cost(start, sigma), _FIRST_DAMPING
        for _ in range(iterations):
            system = self._system(start, first, sigma)
            for _ in range(_TRIALS):
                tried = self._stepped(start, system, first, damping)
                cost_tried = self._cost(tried, sigma)
                if cost_tried < cost:
                    break
                damping = max(8.0 * damping, 1e-6)
            else:
                break
            gain, start, cost = (cost - cost_tried) / cost, tried, cost_tried
            damping = max(0.1 * damping, _LEAST_DAMPING)
            if gain < _LEAST_GAIN:
                break
        return start

    def lens_sigmas(self, given: Reconstruction, first: int, sigma: float) -> FloatArray:
        """Formal sigmas of the lens ``(5,)``, with its values free from the ``first`` on, infinite before."""
        reduced, _, _ = _reduced(self._system(given, first, sigma), 1e-10)
        covariance = np.linalg.pinv(reduced, hermitian=True, rcond=1e-13)
        free = np.sqrt(np.diag(covariance)[first - 5 :])
        return np.concatenate([np.full(first, np.inf), free])

    def _ideal(self, given: Reconstruction) -> tuple[FloatArray, FloatArray]:
        """Images without lens ``(S, 2)``, and points in their cameras ``(S, 3)``."""
        T, points = given.T_camera_world[self.seen.keyframe], given.points[self.seen.point]
        X = np.einsum("sij,sj->si", T[:, :3], points)
        return np.exp(given.lens[0]) * X[:, :2] / np.maximum(X[:, 2:], LEAST_DEPTH), X

    def _squares(self, given: Reconstruction, sigma: float) -> FloatArray:
        return (self.errors(given) ** 2).sum(axis=1) / sigma**2

    def _cost(self, given: Reconstruction, sigma: float) -> float:
        robust = _CAUCHY * np.log1p(self._squares(given, sigma) / _CAUCHY)
        return float(robust.sum() + (((given.lens - _PRIOR) / _PRIOR_SIGMAS) ** 2).sum())

    def _system(self, given: Reconstruction, first: int, sigma: float) -> _System:
        """Normal equations of cameras but the first and the lens, of points, and between them."""
        seen, cameras = self.seen, len(given.T_camera_world)
        n = 6 * (cameras - 1)
        ideal, X = self._ideal(given)
        image, by_ideal, by_lens = _bent(ideal, given.lens)
        weights = 1.0 / (1.0 + self._squares(given, sigma) / _CAUCHY) / sigma**2
        motion = pixel_jacobian(X, np.full(2, np.exp(given.lens[0]))).transpose(2, 1, 0)
        by_point = motion[:, :, 3:] @ given.T_camera_world[seen.keyframe, :3]
        motion[:, :, 3:] *= given.points[seen.point, 3][:, None, None]
        by_pose = by_ideal @ np.concatenate([by_point, motion], axis=2)
        # of the point (four), the camera (six), the lens, and the error
        J = np.concatenate(
            [by_pose, by_lens[:, :, first:], (image - seen.image)[:, :, None]], axis=2
        )
        normal = (J * weights[:, None, None]).transpose(0, 2, 1) @ J
        of_points = _sums(normal[:, :4], seen.point, len(given.points))
        of_cameras = _sums(normal[:, 4:], seen.keyframe, cameras)
        lens, prior = of_cameras[:, 6:-1].sum(axis=0), np.diag(_PRIOR_SIGMAS[first:] ** -2)
        own = block_diag(*of_cameras[1:, :6, 4:10], lens[:, 10:-1] + prior)
        own[:n, n:] = of_cameras[1:, :6, 10:-1].reshape(n, -1)
        own[n:, :n] = own[:n, n:].T
        from_prior = prior @ (given.lens - _PRIOR)[first:]
        side = np.append(of_cameras[1:, :6, -1], lens[:, -1] + from_prior)
        W = np.zeros((len(given.points), 4, cameras, 6))
        W[seen.point, :, seen.keyframe] = normal[:, :4, 4:10]
        W = np.dstack([W[:, :, 1:].reshape(len(W), 4, n), of_points[:, :, 10:-1]])
        V, length = of_points[:, :, :4], given.points[:, :, None] * given.points[:, None]
        V += length * np.trace(V, axis1=1, axis2=2)[:, None, None]  # which no image shows
        return _System(own, side, V, of_points[:, :, -1], W)

    def _stepped(
        self, start: Reconstruction, system: _System, first: int, damping: float
    ) -> Reconstruction:
        try:
            reduced, side, inverse = _reduced(system, damping)
            step = cho_solve(cho_factor(reduced), -side)
        except (LinAlgError, ValueError):
            return start
        by_point = -np.einsum("pij,pj->pi", inverse, system.point_side + system.W @ step)
        n = 6 * (len(start.T_camera_world) - 1)
        moves = step[:n].reshape(-1, 6)
        T, lens = start.T_camera_world.copy(), start.lens.copy()
        T[1:] = compose(from_rotation_vector(moves[:, :3], moves[:, 3:]), T[1:])
        lens[first:] += step[n:]
        return Reconstruction(T, normalised(start.points + by_point), lens)


class _System(NamedTuple):
    """Blocks and right sides: ``own`` of cameras and lens, ``V`` of points; ``W`` ``(P, 4, n)`` between them."""

    own: FloatArray
    side: FloatArray
    V: FloatArray
    point_side: FloatArray
    W: FloatArray


def _reduced(system: _System, damping: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The system without the points, its right side, and the inverse of the points' blocks."""
    diagonal = np.einsum("pii->pi", system.V) * damping + 1e-12
    inverse = np.linalg.inv(system.V + diagonal[:, :, None] * np.eye(4))
    W = system.W.reshape(-1, system.W.shape[2])
    with_points = np.matmul(inverse, system.W).reshape(W.shape)
    own = system.own + np.diag(damping * np.diag(system.own) + 1e-9)
    side = system.side - with_points.T @ system.point_side.ravel()
    return own - with_points.T @ W, side, np.asarray(inverse)


def _turning(seen: FollowedCorners) -> tuple[Problem, Reconstruction] | None:
    """A start by the usual lens: keyframes turn on the spot, as far as they share corners, and points are far."""
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
    rays = normalised(rays[rows & np.isin(seen.point, points)])
    in_world = np.einsum("sji,sj->si", R_camera_world[part.keyframe], rays)
    directions = normalised(_sums(in_world, part.point, len(points)))
    far = normalised(np.column_stack([directions, np.full(len(points), _NEARNESS)]))
    places = _APART * np.random.default_rng(0).normal(size=(len(R), 3))
    start = Reconstruction(make(R_camera_world, places), far, _PRIOR)
    problem = Problem(part)
    for sigma in _FIRST_SIGMAS_PX:
        start = problem.solved(start, _NOTHING, sigma * seen.pixel, _MANY)
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


def _sums(values: FloatArray, groups: NDArray[np.int64], count: int) -> FloatArray:
    """Sums ``(count, ...)`` of the values ``(S, ...)`` of each group ``(S,)``."""
    own = csr_array((np.ones(len(groups)), (groups, np.arange(len(groups)))), (count, len(groups)))
    return (own @ values.reshape(len(values), -1)).reshape(count, *values.shape[1:])
