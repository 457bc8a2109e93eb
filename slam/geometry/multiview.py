"""Multiple-view geometry: the pose of one camera by known points, motions between two views, and triangulation.

A camera is resected robustly from guesses, by consensus where they disagree. It is perturbed on the left,
``Exp(xi) T_camera_world``, rotation first.

A motion between two views of calibrated points is ``x_current ~ R_current_previous @ X_previous + direction``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.geometry.robust import mad_sigma, median
from slam.geometry.se3 import (
    BoolArray,
    FloatArray,
    apply,
    compose,
    length_of,
    make,
    nearest_rotation,
    normalised,
    rotation_matrix,
)

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
# of the distance of a camera that stands still or turns on the spot from its place, over the median depth
_STILL_RATIO = 0.003
# of a corner against that distance: blurred corners share errors
_SHARED_PX = 2.0
_CLEARLY = 2.0  # times the support of the pose by all points, of that by trusted ones in its place
_SAMPLES = 300
PIXEL_SIGMA = 0.7  # of a coordinate of a sighting, pixels
_CONFIDENCE = 0.999
_TRIMMINGS = 4
_RESECTIONS = 200
_LEAST_CONSENSUS = 8


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
    """The order ``(count,)`` of the points for a RANSAC of OpenCV, whose own seed is fixed; 0 is the given one."""
    order = np.arange(count, dtype=np.intp)
    return order if seed == 0 else np.random.default_rng(seed).permutation(order)


def consensus(
    points: FloatArray,
    pixels: FloatArray,
    K: FloatArray,
    iterations: int,
    reprojection_px: float,
    seed: int = 0,
) -> tuple[FloatArray, NDArray[np.intp]]:
    """``T_camera_world`` and rows of the inliers with most support; the identity and none where no pose has any.

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
    params.maxIterations, params.threshold, params.confidence = (
        iterations,
        reprojection_px,
        _CONFIDENCE,
    )
    params.sampler, params.score = cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MSAC
    params.loMethod = cv2.LOCAL_OPTIM_NULL
    is_solved, _, rotation, translation, chosen = cv2.solvePnPRansac(
        points[order], pixels[order], K.copy(), None, params=params
    )
    if not is_solved or chosen is None:
        return np.eye(4), order[:0]
    return make(rotation_matrix(rotation.ravel()), translation.ravel()), order[chosen.ravel()]


def resect(
    guesses: Sequence[FloatArray],
    points: FloatArray,
    pixels: FloatArray,
    K: FloatArray,
    seed: int = 0,
    spread: FloatArray | None = None,
    trusted: BoolArray | None = None,
    still: FloatArray | None = None,
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
        still: place ``(3,)`` from which the camera hardly moved, as in a turn on the spot; None for none.
    """

    def best(votes: BoolArray) -> Resection:
        """The pose by the points that vote ``(M,)``: the first one that most of them fit, or that which most fit."""
        found: list[Resection] = []
        for start in starts(votes):
            found.append(_refined(start, points, spread, pixels, K, votes, still))
            if _support(found[-1], votes) >= _DOUBTFUL_RATIO * votes.sum():
                return found[-1]
        return max(found, key=lambda pose: _support(pose, votes))

    def starts(votes: BoolArray) -> Iterator[FloatArray]:
        yield from guesses
        start, inliers = consensus(points[votes], pixels[votes], K, _SAMPLES, INLIER_PX, seed)
        if len(inliers):
            yield start

    pose = best(np.ones(len(points), np.bool_))
    if trusted is not None and _support(pose, trusted) < _DOUBTFUL_RATIO * trusted.sum():
        by_trusted = best(trusted)
        if _support(by_trusted, trusted) > _CLEARLY * _support(pose, trusted):
            return by_trusted
    return pose


def _support(pose: Resection, votes: BoolArray) -> int:
    return int((pose.residual_px[votes] < INLIER_PX).sum())


def _refined(
    T_camera_world: FloatArray,
    points: FloatArray,
    spread: FloatArray | None,
    pixels: FloatArray,
    K: FloatArray,
    votes: BoolArray,
    still: FloatArray | None,
) -> Resection:
    """Cauchy weights of half an inlier; far from the solution, where all residuals are large, of their median.

    The prior of the place ``still`` is Gaussian: its sigma is a share of the median depth at the start.
    """
    T = T_camera_world.copy()
    focal = np.array([K[0, 0], K[1, 1]])
    rays = (pixels - K[:2, 2]) / focal
    residual, J, X = _whitened(T, points, spread, rays, focal)
    place, pull = np.zeros(3), 0.0
    if still is not None:
        place, pull = still, (_SHARED_PX / (_STILL_RATIO * median(X[:, 2]))) ** 2
    for _ in range(_ITERATIONS):
        norm = np.hypot(*residual)
        scale = max(0.5 * INLIER_PX, median(norm[votes]))
        weight = np.where(votes & (X[:, 2] > LEAST_DEPTH), 1.0 / (1.0 + (norm / scale) ** 2), 0.0)
        weighted = (weight * J).reshape(6, -1)
        information = weighted @ J.reshape(6, -1).T
        information += (1e-9 + _DAMPING * np.trace(information)) * np.eye(6)
        information[3:, 3:] += pull * np.eye(3)
        gradient = weighted @ residual.ravel()
        gradient[3:] += pull * (T[:3, :3] @ place + T[:3, 3])
        step = np.asarray(np.linalg.solve(information, -gradient), np.float64)
        T = compose(make(rotation_matrix(step[:3]), step[3:]), T)
        residual, J, X = _whitened(T, points, spread, rays, focal)
        if np.abs(step).max() < _CONVERGED:
            break
    in_front = X[:, 2] > LEAST_DEPTH
    sigma = max(mad_sigma(residual[:, votes]), _LEAST_PIXEL_SIGMA)
    sigmas = sigma * np.sqrt(np.diag(np.linalg.inv(information)))
    return Resection(T, np.where(in_front, np.hypot(*residual), np.inf), sigmas)


def _whitened(
    T_camera_world: FloatArray,
    points: FloatArray,
    spread: FloatArray | None,
    rays: FloatArray,
    focal: FloatArray,
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
    residual, J = (
        of - (taken * (of * line).sum(axis=-2))[..., None, :] * line for of in (residual, J)
    )
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


@dataclass(frozen=True)
class UnitRelativePose:
    """A motion between two views without its length: ``direction`` ``(3,)`` in the current camera, unit length."""

    R_current_previous: FloatArray
    direction: FloatArray

    @classmethod
    def of(cls, T_current_previous: FloatArray) -> tuple[Self, float] | None:
        """That of a transform, and its length; None where it has none."""
        length = length_of(T_current_previous[:3, 3])
        return (
            (cls(T_current_previous[:3, :3], T_current_previous[:3, 3] / length), length)
            if length > 0
            else None
        )


def unit_pose_by_essential(
    rays_previous: FloatArray, rays_current: FloatArray, tolerance: float, seed: int = 0
) -> UnitRelativePose | None:
    """The motion with most support among matched rays ``(M, 3)`` with z = 1, within ``tolerance`` on z = 1.

    Args:
        rays_previous: ``(M, 3)`` with z = 1, in the previous camera.
        rays_current: of the same points ``(M, 3)`` with z = 1, in the current one.
        tolerance: largest error of an inlier on the plane z = 1.
        seed: of the draws.
    """
    order = ransac_order(len(rays_previous), seed)
    previous, current = rays_previous[order, :2], rays_current[order, :2]
    E, mask = cv2.findEssentialMat(
        previous,
        current,
        np.eye(3),
        method=cv2.USAC_MAGSAC,
        prob=0.999,
        threshold=tolerance,
        maxIters=1000,
    )
    if E is None or E.shape != (3, 3) or int(mask.sum()) < _LEAST_CONSENSUS:
        return None
    # of four motions that explain it, the one by which most points are in front of both cameras
    _, R_current_previous, direction, _, _ = cv2.recoverPose(
        E, previous, current, np.eye(3), distanceThresh=np.inf, mask=mask
    )
    return UnitRelativePose(R_current_previous, direction.ravel())


def unit_poses_by_homography(
    rays_previous: FloatArray, rays_current: FloatArray, tolerance: float, seed: int = 0
) -> list[UnitRelativePose]:
    """The motions, at most two, by which a plane explains the matched rays ``(M, 3)`` with z = 1, within ``tolerance``.

    The plane must lie in front of the previous camera where its inliers see it.

    Args:
        rays_previous: ``(M, 3)`` with z = 1, in the previous camera.
        rays_current: of the same points ``(M, 3)`` with z = 1, in the current one.
        tolerance: largest error of an inlier on the plane z = 1.
        seed: of the draws.
    """
    order = ransac_order(len(rays_previous), seed)
    rays_previous, rays_current = rays_previous[order], rays_current[order]
    H, mask = cv2.findHomography(
        rays_previous[:, :2].copy(),
        rays_current[:, :2].copy(),
        cv2.USAC_MAGSAC,
        tolerance,
        maxIters=1000,
    )
    if H is None or int(mask.sum()) < _LEAST_CONSENSUS:
        return []
    inliers = rays_previous[mask.ravel().astype(bool)]
    _, rotations, translations, normals = cv2.decomposeHomographyMat(H, np.eye(3))
    return [
        UnitRelativePose(R, t.ravel() / np.linalg.norm(t))
        for R, t, normal in zip(rotations, translations, normals, strict=True)
        if np.linalg.norm(t) > 0 and np.median(inliers @ normal) > 0
    ]


def unit_pose_by_pnp(
    rays_previous: FloatArray,
    rays_current: FloatArray,
    depth_previous: FloatArray,
    tolerance: float,
    seed: int = 0,
) -> UnitRelativePose | None:
    """The motion with most support among the same rays where their depths ``(M,)`` are known, else NaN.

    Known depth separates dynamic objects from the static scene.

    Args:
        rays_previous: ``(M, 3)`` with z = 1, in the previous camera.
        rays_current: of the same points ``(M, 3)`` with z = 1, in the current one.
        depth_previous: z-depth ``(M,)`` in the previous camera, NaN where unknown.
        tolerance: largest error of an inlier on the plane z = 1.
        seed: of the draws.
    """
    known = np.isfinite(depth_previous)
    if known.sum() < _LEAST_CONSENSUS:
        return None
    points = rays_previous[known] * depth_previous[known, None]
    T_current_previous, _ = consensus(
        points, rays_current[known, :2].copy(), np.eye(3), _RESECTIONS, tolerance, seed
    )
    found = UnitRelativePose.of(T_current_previous)
    return found[0] if found else None


def parallax_px(
    rays_previous: FloatArray,
    rays_current: FloatArray,
    R_current_previous: FloatArray,
    focal: tuple[float, float] | float,
) -> FloatArray:
    """Optical flow of each point in pixels ``(M,)`` without that of the rotation.

    Args:
        rays_previous: ``(M, 3)`` with z = 1, in the previous camera.
        rays_current: of the same points ``(M, 3)`` with z = 1, in the current one.
        R_current_previous: the rotation ``(3, 3)`` between them.
        focal: both focal lengths, or one for both, pixels.
    """
    rotated = rays_previous @ R_current_previous.T
    rotated = rotated[:, :2] / np.maximum(rotated[:, 2:], 1e-6)
    difference = (rays_current[:, :2] - rotated) * focal
    return np.linalg.norm(difference, axis=1)


def rotation_between(rays_previous: FloatArray, rays_current: FloatArray) -> FloatArray:
    """``R_current_previous`` that fits the matched rays ``(M, 3)`` best without translation.

    Orthogonal Procrustes on unit rays, trimmed to the better three quarters, so that dynamic objects do not bias it.
    """
    unit_previous, unit_current = normalised(rays_previous), normalised(rays_current)
    kept = np.ones(len(unit_previous), dtype=bool)
    most = 3 * len(unit_previous) // 4
    for _ in range(_TRIMMINGS):
        R_current_previous = nearest_rotation(unit_current[kept].T @ unit_previous[kept])
        error = np.linalg.norm(unit_current - unit_previous @ R_current_previous.T, axis=1)
        kept = error <= np.partition(error, most)[most]
    return R_current_previous


def triangulated_depth(
    rays_previous: FloatArray, rays_current: FloatArray, unit_pose: UnitRelativePose
) -> FloatArray:
    """z-depth ``(M,)`` in the previous camera in units of the motion's length; negative behind the camera.

    From ``z R x + t = z' x'``: the cross product with x' leaves ``z (x' x R x) = -(x' x t)``.
    """
    across, along = _across_and_along(rays_previous, rays_current, unit_pose)
    return (across * along).sum(axis=0) / np.maximum((across**2).sum(axis=0), 1e-18)


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
    return cross(current, unit_pose.R_current_previous @ rays_previous.T), -cross(
        current, unit_pose.direction
    )


def depth_in_current(
    rays_previous: FloatArray, depth_previous: FloatArray, unit_pose: UnitRelativePose
) -> FloatArray:
    """z-depth ``(M,)`` in the current camera of points at ``depth_previous`` ``(M,)``, both in the motion's length."""
    return (
        depth_previous * (rays_previous @ unit_pose.R_current_previous[2]) + unit_pose.direction[2]
    )


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """``a x b`` of ``(3,)`` or ``(3, M)``; several times faster than NumPy's own."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
