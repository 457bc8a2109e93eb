"""Place retrieval by a bag of words that are trained on the run itself.

Words are compared by tf-idf, as in DBoW2 (Galvez-Lopez and Tardos 2012), with one flat vocabulary
instead of a downloaded tree: a run has few enough frames for it, and words trained on its own
images discriminate better.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import norm

from slam.frames import Descriptors, View
from slam.geometry.se3 import FloatArray

_TRAINING_DESCRIPTORS = 15_000
_ROUNDS = 3
_WORDS = 1000  # size of the binary vocabulary learned on the run


class PlaceIndex:
    """Finds the views of a drive that are similar to a new one; ``weights`` ``(V, words)`` are tf-idf vectors."""

    def __init__(self, views: Sequence[View]) -> None:
        """Train the vocabulary on the drive's views, at least one."""
        everything = joined(views, "descriptors", 32, np.uint8)
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


def joined(views: Sequence[View], name: str, columns: int, kind: type) -> NDArray[Any]:
    """The rows ``(N, columns)`` of one array of all views."""
    return np.concatenate([np.zeros((0, columns), kind), *(getattr(each, name) for each in views)])


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


def nearest_words(descriptors: Descriptors, words: Descriptors) -> NDArray[np.integer[Any]]:
    """The word ``(M,)`` of each descriptor by Hamming distance."""
    if not len(descriptors):
        return np.zeros(0, np.intp)
    _, nearest = cv2.batchDistance(descriptors, words, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=1)
    return nearest[:, 0]


def _word_counts(views: Sequence[View], word: NDArray[np.integer[Any]]) -> csr_array:
    """Counts ``(V, words)`` of each word in each view; ``word`` is of all descriptors, view after view."""
    row = np.repeat(np.arange(len(views)), [len(view) for view in views])
    counts = csr_array((np.ones(len(word)), (row, word)), shape=(len(views), _WORDS))
    counts.sum_duplicates()
    return counts


def _weighted(counts: csr_array, inverse_frequency: FloatArray) -> csr_array:
    """Unit tf-idf vectors, of the square roots of the counts: repeated structure counts less (Jegou et al. 2009)."""
    weights = counts.copy()
    weights.data = np.sqrt(counts.data) * inverse_frequency[counts.indices]
    lengths = np.maximum(norm(weights, axis=1), 1e-12)
    weights.data = weights.data / np.repeat(lengths, np.diff(weights.indptr))
    return weights
