"""Places known again by binary descriptors of corners, in a bag of words trained on the run and compared by tf-idf.

Frames of a drive have ORB (Rublee et al. 2011) at corners of its own. Corners that are tracked have SIFT (Lowe 2004) as
256 bits, so that words, matching and files are the same: two thresholds code a value, and Hamming's distance is the
distance between the sums of coded differences.

Words are those of DBoW2 (Galvez-Lopez and Tardos 2012), with one flat vocabulary instead of a downloaded tree: a run
has few enough frames for it, and words trained on its own images discriminate better.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from erfsfm.common.processes import side_by_side
from slam.frames import DepthMap, Descriptors, Frame, Grey, Intrinsics, View, nearest_depth, trusted_depth
from slam.geometry.se3 import FloatArray

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

    def view(self, frame: Frame, depth_unscaled: DepthMap, height_unscaled: float | None = None) -> View:
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
        cv2.KeyPoint(0.5 * float(u) - 0.25, 0.5 * float(v) - 0.25, _SIFT_SIZE_PX / 2, float(angle), 1.0, 0, 0)
        for (u, v), angle in zip(pixels, _directions_deg(grey, pixels), strict=True)
    ]
    _, values = cv2.SIFT.create().compute(half, corners)
    roots = np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1e-9))
    return np.packbits(np.concatenate([roots > _LOW, roots > _HIGH], axis=1), axis=1)


def hamming(first: Descriptors, second: Descriptors) -> NDArray[np.float32]:
    """Differing bits ``(M, N)`` of every pair of descriptors ``(M, 32)`` and ``(N, 32)``."""
    words_first, words_second = (np.ascontiguousarray(d).view(np.uint64).T for d in (first, second))  # (4, M), (4, N)
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
        everything = np.concatenate([np.zeros((0, 32), np.uint8), *(view.descriptors for view in views)])
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
    take = np.linspace(0, len(descriptors) - 1, min(len(descriptors), _TRAINING_DESCRIPTORS)).astype(int)
    sample = descriptors[take]
    centres = np.unique(sample[np.linspace(0, len(sample) - 1, min(words, len(sample))).astype(int)], axis=0)
    bits = np.unpackbits(sample, axis=1).astype(np.float32)
    for _ in range(_ROUNDS if len(centres) else 0):
        word = nearest_words(sample, centres)
        members = csr_array((np.ones(len(word), np.float32), (word, np.arange(len(word)))), (len(centres), len(word)))
        count = np.bincount(word, minlength=len(centres))[:, None]
        majority = np.packbits(members @ bits > count / 2.0, axis=1)
        centres = np.where(count > 0, majority, centres)
    return centres


def nearest_words(descriptors: Descriptors, words: Descriptors) -> NDArray[np.int64]:
    """The word ``(M,)`` of each descriptor by Hamming distance."""
    blocks = [descriptors[k : k + _BLOCK_DESCRIPTORS] for k in range(0, len(descriptors), _BLOCK_DESCRIPTORS)]
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
