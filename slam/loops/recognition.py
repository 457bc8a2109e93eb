"""Place recognition: descriptors of corners, retrieval by a bag of words, verification by perspective-n-point.

Frames of a drive have ORB (Rublee et al. 2011) at corners of its own. Corners that are tracked have SIFT (Lowe 2004) as
256 bits, so that words, matching and files are the same: two thresholds code a value, and Hamming's distance is the
distance between the sums of coded differences.

Words are trained on the run itself and compared by tf-idf, as in DBoW2 (Galvez-Lopez and Tardos 2012), with one flat
vocabulary instead of a downloaded tree: a run has few enough frames for it, and words trained on its own images
discriminate better.

A candidate is verified on the points of two views, in both directions. All thresholds are independent of scale: pixels,
ratios, degrees, and lengths over the depth of the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from erfsfm.common.processes import side_by_side
from slam.frames import (
    LOOP_SOURCE,
    DepthMap,
    Descriptors,
    Frame,
    Grey,
    Intrinsics,
    RelativePose,
    View,
    nearest_depth,
    trusted_depth,
)
from slam.geometry.multiview import consensus, resect
from slam.geometry.se3 import FloatArray, apply, invert, make, rotation_angle

_CELL_PX = 32
_DETECTED_PER_KEPT = 4
_EDGE_PX = 16
_CORNER_CONTRAST = 10  # least contrast of a corner, grey levels
_MAX_FEATURES = 500  # largest number of corners kept of a frame
_SIFT_SIZE_PX = 8.0
# terciles of square roots of SIFT's normed values (Arandjelovic and Zisserman 2012) over the corners of a kitchen
_LOW, _HIGH = 0.034, 0.082
_RADIUS_PX = 15
_BLUR_PX = 2.0
_TRAINING_DESCRIPTORS = 15_000
_ROUNDS = 3
_BLOCK_DESCRIPTORS = 200  # fit the processor's cache
_WORDS = 1000  # size of the binary vocabulary learned on the run
_RATIO = 0.85  # largest ratio of nearest to second nearest descriptor distance
_RANSAC_ITERATIONS = 200  # RANSAC iterations of PnP
_CORNER_SIGMA_WIDENING = 1.25  # factor on the sigmas by corners
_LENGTH_RELATIVE_SIGMA = 0.04  # translation sigma over the translation
_MIN_SPREAD_RATIO = 0.1  # least standard deviation of the inliers' columns over the image width
_LEAST_SCALES = 8  # corners with points in both views, which give the ratio of their units


class FeatureExtractor:
    """Extracts features of the frames of one sequence, spread over the image by a grid."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        self._intrinsics = intrinsics
        self._orb = cv2.ORB.create(
            nfeatures=_DETECTED_PER_KEPT * _MAX_FEATURES,
            nlevels=6,
            edgeThreshold=_EDGE_PX,
            fastThreshold=_CORNER_CONTRAST,
        )

    def view(
        self, frame: Frame, depth_unscaled: DepthMap, height_unscaled: float | None = None
    ) -> View:
        """Features of a frame, at the size of its image.

        Args:
            frame: the frame, at the size of the intrinsics.
            depth_unscaled: its learned z-depth ``(H, W)``.
            height_unscaled: camera height in the same unit (see `trusted_depth`).
        """
        pixels, descriptors = self.corners(frame.grey)
        z = trusted_depth(nearest_depth(depth_unscaled, pixels), height_unscaled)
        points = self._intrinsics.rays(pixels) * z[:, None]
        return View(frame.index, pixels, descriptors, points.astype(np.float32))

    def corners(self, grey: Grey) -> tuple[NDArray[np.float32], Descriptors]:
        """Pixels ``(M, 2)`` and descriptors ``(M, 32)``."""
        detected = self._orb.detect(grey, None)
        pixels = np.array([k.pt for k in detected]).reshape(-1, 2)
        response = np.array([k.response for k in detected])
        column, row = (pixels // _CELL_PX).astype(int).T
        cell = row * (grey.shape[1] // _CELL_PX + 1) + column
        # the best of every cell first, then the second best, and so on
        by_cell = np.lexsort((-response, cell))
        rank = np.arange(len(by_cell)) - np.searchsorted(cell[by_cell], cell[by_cell])
        strongest = by_cell[np.lexsort((-response[by_cell], rank))][:_MAX_FEATURES]
        chosen, descriptors = self._orb.compute(grey, [detected[k] for k in strongest])
        if not chosen:
            return np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)
        return np.array([keypoint.pt for keypoint in chosen], np.float32), descriptors


def describe(grey: Grey, pixels: NDArray[np.floating[Any]]) -> Descriptors:
    """Descriptors ``(M, 32)`` of corners ``(M, 2)``, each turned into its own direction."""
    if not len(pixels):
        return np.zeros((0, 32), np.uint8)
    # at half the size a quarter of the pixels describe the same surroundings
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    corners = [
        cv2.KeyPoint(
            0.5 * float(u) - 0.25, 0.5 * float(v) - 0.25, _SIFT_SIZE_PX / 2, float(angle), 1.0, 0, 0
        )
        for (u, v), angle in zip(pixels, _directions_deg(grey, pixels), strict=True)
    ]
    _, values = cv2.SIFT.create().compute(half, corners)
    roots = np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1e-9))
    return np.packbits(np.concatenate([roots > _LOW, roots > _HIGH], axis=1), axis=1)


def hamming(first: Descriptors, second: Descriptors) -> NDArray[np.float32]:
    """Differing bits ``(M, N)`` of every pair of descriptors ``(M, 32)`` and ``(N, 32)``."""
    words_first, words_second = (
        np.ascontiguousarray(d).view(np.uint64).T for d in (first, second)
    )  # (4, M), (4, N)
    differing = np.zeros((len(first), len(second)), np.uint16)
    for a, b in zip(words_first, words_second, strict=True):
        differing += np.bitwise_count(a[:, None] ^ b)
    return differing.astype(np.float32)


def _directions_deg(grey: Grey, pixels: NDArray[np.floating[Any]]) -> FloatArray:
    """From each corner to the centroid of the grey levels around it (Rosin 1999), degrees in [0, 360)."""
    y, x = np.mgrid[-_RADIUS_PX : _RADIUS_PX + 1, -_RADIUS_PX : _RADIUS_PX + 1]
    inside = x**2 + y**2 <= _RADIUS_PX**2
    x, y = x[inside], y[inside]
    border = _RADIUS_PX + 1
    blurred = cv2.GaussianBlur(grey, (0, 0), _BLUR_PX)
    padded = cv2.copyMakeBorder(blurred, border, border, border, border, cv2.BORDER_REFLECT)
    u, v = np.rint(pixels).astype(np.int64).T + border
    places = np.add.outer(v * padded.shape[1] + u, y * padded.shape[1] + x)
    around = padded.ravel()[places].astype(np.float32)  # whole numbers, of which sums are exact
    down, right = (around @ np.column_stack([y, x]).astype(np.float32)).astype(np.float64).T
    return np.asarray(np.rad2deg(np.arctan2(down, right)) % 360.0)


class PlaceIndex:
    """Finds the views of a drive that are similar to a new one; ``weights`` ``(V, words)`` are tf-idf vectors."""

    def __init__(self, views: Sequence[View]) -> None:
        """Train the vocabulary on the drive's views, at least one."""
        everything = np.concatenate(
            [np.zeros((0, 32), np.uint8), *(view.descriptors for view in views)]
        )
        self._words = train_vocabulary(everything, _WORDS)
        counts = _word_counts(views, nearest_words(everything, self._words))
        seen_in = np.bincount(counts.indices, minlength=_WORDS)
        self._inverse_frequency: FloatArray = np.log(len(views) / np.maximum(seen_in, 1))
        self.weights = _weighted(counts, self._inverse_frequency)

    def nearest(self, view: View, count: int) -> list[int]:
        """Rows of at most ``count`` views that share words with this one, the most similar first."""
        if not len(self._words) or not len(view):
            return []
        word = nearest_words(view.descriptors, self._words)
        query = _weighted(_word_counts([view], word), self._inverse_frequency)
        scores = (self.weights @ query.T).toarray().ravel()
        best = np.argsort(-scores, kind="stable")[:count]
        return [int(row) for row in best if scores[row] > 0]


def train_vocabulary(descriptors: Descriptors, words: int) -> Descriptors:
    """At most ``words`` binary words ``(K, 32)`` by k-majority (Grana et al. 2013) on an even sample of descriptors."""
    take = np.linspace(
        0, len(descriptors) - 1, min(len(descriptors), _TRAINING_DESCRIPTORS)
    ).astype(int)
    sample = descriptors[take]
    centres = np.unique(
        sample[np.linspace(0, len(sample) - 1, min(words, len(sample))).astype(int)], axis=0
    )
    bits = np.unpackbits(sample, axis=1).astype(np.float32)
    for _ in range(_ROUNDS if len(centres) else 0):
        word = nearest_words(sample, centres)
        members = csr_array(
            (np.ones(len(word), np.float32), (word, np.arange(len(word)))),
            (len(centres), len(word)),
        )
        count = np.bincount(word, minlength=len(centres))[:, None]
        majority = np.packbits(members @ bits > count / 2.0, axis=1)
        centres = np.where(count > 0, majority, centres)
    return centres


def nearest_words(descriptors: Descriptors, words: Descriptors) -> NDArray[np.int64]:
    """The word ``(M,)`` of each descriptor by Hamming distance."""
    blocks = [
        descriptors[k : k + _BLOCK_DESCRIPTORS]
        for k in range(0, len(descriptors), _BLOCK_DESCRIPTORS)
    ]
    nearest = side_by_side(lambda block: hamming(block, words).argmin(axis=1), blocks)
    return np.concatenate([np.zeros(0, np.int64), *nearest])


def _word_counts(views: Sequence[View], word: NDArray[np.int64]) -> csr_array:
    """Counts ``(V, words)`` of each word in each view; ``word`` is of all descriptors, view after view."""
    row = np.repeat(np.arange(len(views)), [len(view) for view in views])
    counts = csr_array((np.ones(len(word)), (row, word)), shape=(len(views), _WORDS))
    counts.sum_duplicates()
    return counts


def _weighted(counts: csr_array, inverse_frequency: FloatArray) -> csr_array:
    """Unit tf-idf vectors, of the square roots of the counts: repeated structure counts less (Jegou et al. 2009)."""
    weights = counts.copy()
    weights.data = np.sqrt(counts.data) * inverse_frequency[counts.indices]
    norm = np.sqrt(np.asarray((weights * weights).sum(axis=1)).ravel())
    weights.data = weights.data / np.repeat(np.maximum(norm, 1e-12), np.diff(weights.indptr))
    return weights


@dataclass(frozen=True)
class LoopThresholds:
    """Independent of scale: pixels, ratios, degrees. Distances and drift of support are by frames or by keyframes."""

    min_inliers: int = 20  # in each direction
    agreement_deg: float = 2.0  # of the rotations measured in both directions
    agreement_ratio: float = 0.1  # of the translations, over the depth
    min_support: int = 2  # images with loops nearby that agree
    candidates: int = 2  # places verified for a view
    candidate_spacing: int = 10  # between these, frames
    least_score: float = 0.2  # similarity of a candidate, over that of neighbouring views
    max_hamming: int = 64  # bits between matching descriptors
    reprojection_px: float = 3.0  # of an inlier
    min_inlier_ratio: float = 0.4  # among the matches with depth
    max_drift_ratio: float = 0.3  # correction over the path between both ends
    support_distance: int = 20  # of both ends, within which loops must agree
    support_drift_deg: float = (
        0.1  # rotation drift of the odometry between supporting loops, per frame or keyframe
    )
    alone_inliers: int = 120  # from which on a loop needs no support
    rotation_floor_deg: float = 0.02  # of the sigmas
    translation_floor_ratio: float = 0.0003  # of the sigmas, over the depth
    has_units: bool = False  # the points of both views may have different units


OF_FRAMES = LoopThresholds()
# keyframes' points are exact within a map that drifts, their descriptors further apart in distance and roll
OF_KEYFRAMES = LoopThresholds(
    min_inliers=15,
    agreement_deg=4.0,
    agreement_ratio=0.15,
    min_support=1,
    candidates=12,
    candidate_spacing=0,
    least_score=0.0,
    max_hamming=100,
    reprojection_px=4.0,
    min_inlier_ratio=0.3,
    support_distance=4,
    support_drift_deg=0.5,
    alone_inliers=40,
    rotation_floor_deg=0.5,
    translation_floor_ratio=0.02,
    has_units=True,
)


@dataclass(frozen=True, eq=False)
class Loop:
    """A verified loop; ``inliers`` is the smaller of both directions.

    ``measured`` is in the unit of the earlier view, ``scale`` that of the later one in it. ``corners`` ``(M, 2)`` are
    rows of corners of the earlier and of the later view that show one point, ``pixels`` ``(M, 2, 2)`` where they are.
    """

    measured: RelativePose
    inliers: int
    score: float
    scale: float = 1.0
    corners: NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 2), np.intp))
    pixels: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2, 2), np.float32))

    @property
    def ends(self) -> tuple[int, int]:
        """Earlier and later frame."""
        return self.measured.from_index, self.measured.to_index

    def refused(self, reason: str) -> RejectedLoop:
        """The same loop, rejected for a reason."""
        return RejectedLoop(*self.ends, reason, self.score, self.inliers)


@dataclass(frozen=True)
class RejectedLoop:
    """A rejected candidate or loop."""

    from_index: int
    to_index: int
    reason: str
    score: float
    inliers: int = 0


class Sighting(NamedTuple):
    """Points seen by a camera: ``T_camera_points``, its ``sigmas`` ``(6,)``, rows of the ``inliers``.

    ``depth`` is their median z-depth in the camera that measured them.
    """

    T_camera_points: FloatArray
    sigmas: FloatArray
    inliers: NDArray[np.intp]
    depth: float


class LoopVerifier:
    """Measures ``T_earlier_later`` between two views of one camera, in the unit of the points of the earlier one."""

    def __init__(self, thresholds: LoopThresholds, intrinsics: Intrinsics, seed: int = 0) -> None:
        self.thresholds = thresholds
        self._intrinsics = intrinsics
        self._seed = seed

    def verify(self, earlier: View, later: View, score: float) -> Loop | RejectedLoop:
        """Measure the pose of the later view in the earlier one, or reject it with a reason."""
        rows_earlier, rows_later = matches(earlier, later, self.thresholds)

        def refused(reason: str, inliers: int = 0) -> RejectedLoop:
            return RejectedLoop(earlier.index, later.index, reason, score, inliers)

        if len(rows_earlier) < self.thresholds.min_inliers:
            return refused(f"only {len(rows_earlier)} matches")
        points_earlier, points_later = earlier.points[rows_earlier], later.points[rows_later]
        forward = self.resect(points_earlier, later.pixels[rows_later])
        if isinstance(forward, str):
            return refused(forward)
        backward = self.resect(points_later, earlier.pixels[rows_earlier])
        if isinstance(backward, str):
            return refused(f"backwards {backward}", len(forward.inliers))
        inliers = min(len(forward.inliers), len(backward.inliers))
        scale = (
            _scale(points_earlier, points_later, forward, backward)
            if self.thresholds.has_units
            else 1.0
        )
        if scale is None:
            return refused("few corners have points in both views", inliers)
        T_again = backward.T_camera_points.copy()
        T_again[:3, 3] *= scale
        difference = forward.T_camera_points @ T_again
        rotation_deg = float(np.rad2deg(rotation_angle(difference[:3, :3])))
        depth = min(forward.depth, scale * backward.depth)
        translation_ratio = float(np.linalg.norm(difference[:3, 3])) / depth
        if (
            rotation_deg > self.thresholds.agreement_deg
            or translation_ratio > self.thresholds.agreement_ratio
        ):
            reason = f"both directions differ by {rotation_deg:.1f} degrees and {translation_ratio:.0%} of the depth"
            return refused(reason, inliers)
        T_forward = invert(forward.T_camera_points)
        half = Rotation.from_rotvec(
            0.5 * Rotation.from_matrix(T_forward[:3, :3].T @ T_again[:3, :3]).as_rotvec()
        )
        T_middle = make(
            T_forward[:3, :3] @ half.as_matrix(), 0.5 * (T_forward[:3, 3] + T_again[:3, 3])
        )
        sigmas = self._sigmas(
            T_middle,
            depth,
            difference,
            forward.sigmas,
            backward.sigmas * np.repeat([1.0, scale], 3),
        )
        measured = RelativePose(earlier.index, later.index, T_middle, sigmas, LOOP_SOURCE)
        shared = np.union1d(forward.inliers, backward.inliers)
        corners = np.column_stack([rows_earlier[shared], rows_later[shared]])
        pixels = np.stack([earlier.pixels[corners[:, 0]], later.pixels[corners[:, 1]]], axis=1)
        return Loop(measured, inliers, score, scale, corners, pixels)

    def resect(self, points: NDArray[np.float32], pixels: NDArray[np.float32]) -> Sighting | str:
        """The camera that sees points ``(M, 3)``, NaN where unknown, at pixels ``(M, 2)``; or why not."""
        thresholds, K = self.thresholds, self._intrinsics.K
        known = np.flatnonzero(np.isfinite(points).all(axis=1))
        points_known, pixels_known = (
            points[known].astype(np.float64),
            pixels[known].astype(np.float64),
        )
        if len(known) < thresholds.min_inliers:
            return f"only {len(known)} matches have a trusted depth"
        tolerance, iterations = thresholds.reprojection_px, _RANSAC_ITERATIONS
        T_start, inliers = consensus(
            points_known, pixels_known, K, iterations, tolerance, self._seed
        )
        count = len(inliers)
        if count < thresholds.min_inliers or count < thresholds.min_inlier_ratio * len(known):
            return f"only {count} of {len(known)} matches are inliers"
        extent = pixels_known[inliers].std(axis=0) / [
            self._intrinsics.width,
            self._intrinsics.height,
        ]
        if extent[0] < _MIN_SPREAD_RATIO or extent[1] < _MIN_SPREAD_RATIO / 2:
            return f"{count} inliers in a small part of the image"
        seen = resect([T_start], points_known[inliers], pixels_known[inliers], K)
        return Sighting(
            seen.T_camera_world,
            seen.sigmas,
            known[inliers],
            float(np.median(points_known[inliers, 2])),
        )

    def _sigmas(
        self,
        T_a_b: FloatArray,
        depth: float,
        difference: FloatArray,
        forward: FloatArray,
        backward: FloatArray,
    ) -> FloatArray:
        """Sigmas ``(6,)`` in camera b: of corners, of learned depth, and half the difference of both directions.

        Both directions use the same corners, whose errors are correlated: averaging does not reduce the sigmas.
        """
        corners = _CORNER_SIGMA_WIDENING * np.hypot(forward, backward)
        rotation = Rotation.from_matrix(difference[:3, :3]).as_rotvec()
        disagreement = np.concatenate([rotation, difference[:3, 3]]) / 2
        length_sigma = _LENGTH_RELATIVE_SIGMA * float(np.linalg.norm(T_a_b[:3, 3]))
        translation_floor = np.hypot(self.thresholds.translation_floor_ratio * depth, length_sigma)
        floors = np.repeat([np.deg2rad(self.thresholds.rotation_floor_deg), translation_floor], 3)
        return np.asarray(np.linalg.norm([corners, disagreement, floors], axis=0))


def matches(
    first: View, second: View, thresholds: LoopThresholds
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of mutual nearest neighbours by Hamming distance that pass Lowe's ratio test."""
    if min(len(first), len(second)) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    distance = hamming(first.descriptors, second.descriptors)
    rows, nearest = np.arange(len(first)), distance.argmin(axis=1)
    best = distance[rows, nearest]
    kept = (distance.argmin(axis=0)[nearest] == rows) & (best <= thresholds.max_hamming)
    distance[rows, nearest] = np.inf
    kept &= best < _RATIO * distance.min(axis=1)
    return rows[kept], nearest[kept]


def _scale(
    points_first: NDArray[np.float32],
    points_second: NDArray[np.float32],
    forward: Sighting,
    backward: Sighting,
) -> float | None:
    """The unit of the second view in that of the first, by the depths of points that both have."""
    both = np.intersect1d(forward.inliers, backward.inliers)
    if len(both) < _LEAST_SCALES:
        return None
    seen_by_second = apply(forward.T_camera_points, points_first[both].astype(np.float64))[:, 2]
    seen_by_first = apply(backward.T_camera_points, points_second[both].astype(np.float64))[:, 2]
    ratios = (
        np.median(seen_by_second / points_second[both, 2]),
        np.median(points_first[both, 2] / seen_by_first),
    )
    return float(np.sqrt(ratios[0] * ratios[1]))
