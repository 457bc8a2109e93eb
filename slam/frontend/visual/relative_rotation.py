"""Turns over two steps at once mend the turns of single steps.

A corner errs by as much over two steps as over one, and where a window drags it to one side it does so in every step.
Measured between frames that lie farther apart, the same error is made half as often
(``docs/design/visual-front-end.md``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from slam.se3 import FloatArray

# single steps are believed less than their corners promise: what they err by, their neighbours err by too
_STEP_WIDENING = 3.0
_ITERATIONS = 4
_OUTLIER_SIGMAS = 3.0


@dataclass(frozen=True)
class RelativeRotation:
    """The turn from one frame to another some steps later, seen in these two images alone.

    ``R_to_from`` ``(3, 3)`` takes points of the earlier camera to the axes of the later one; ``sigmas`` ``(3,)`` are
    those of its rotation vector in the later camera, radians.
    """

    from_index: int
    to_index: int
    R_to_from: FloatArray
    sigmas: FloatArray

    @property
    def steps(self) -> range:
        """The steps that it spans, by their first frames."""
        return range(self.from_index, self.to_index)


@dataclass(frozen=True)
class StepRotation:
    """The turn of one step: ``R_current_previous`` ``(3, 3)``, ``sigmas`` ``(3,)`` in the current camera, radians."""

    R_current_previous: FloatArray
    sigmas: FloatArray


def smooth_rotations(
    turns: Mapping[int, StepRotation], relative_rotations: Sequence[RelativeRotation]
) -> dict[int, FloatArray]:
    """The turns that explain single steps and spans best, robustly.

    Least squares over one small rotation for each step, in its current camera; a span's error is the sum of those of
    its steps, each seen from the span's end.

    Args:
        turns: by the first frame of each step.
        spans: those with a step that is not among ``turns`` say nothing.

    Returns:
        ``R_current_previous`` ``(3, 3)`` of every step.
    """
    usable = [span for span in relative_rotations if all(step in turns for step in span.steps)]
    if not usable:
        return {step: turn.R_current_previous for step, turn in turns.items()}
    place = {step: 3 * n for n, step in enumerate(turns)}
    places, columns, entries, missing = [], [], [], []
    corner = np.arange(9)
    for n, span in enumerate(usable):
        R_to_here = np.eye(3)
        for step in reversed(span.steps):
            places.append(3 * n + corner // 3)
            columns.append(place[step] + corner % 3)
            entries.append((R_to_here / span.sigmas[:, None]).ravel())
            R_to_here = R_to_here @ turns[step].R_current_previous
        missing.append(Rotation.from_matrix(span.R_to_from @ R_to_here.T).as_rotvec() / span.sigmas)
    shape = 3 * len(usable), 3 * len(turns)
    A = coo_array((np.concatenate(entries), (np.concatenate(places), np.concatenate(columns))), shape=shape).tocsr()
    target = np.concatenate(missing)
    # overlapping spans share their images: as many as overlap count as one
    overlapping = max(len(span.steps) for span in usable)
    own = 1.0 / (_STEP_WIDENING * np.concatenate([turn.sigmas for turn in turns.values()])) ** 2
    prior = coo_array((own, (np.arange(len(own)),) * 2)).tocsr()
    correction = np.zeros(len(own))
    for _ in range(_ITERATIONS):
        surprise = np.linalg.norm((A @ correction - target).reshape(-1, 3), axis=1)
        weights = np.repeat(1.0 / (1.0 + (surprise / _OUTLIER_SIGMAS) ** 2), 3) / overlapping
        weighted = A.multiply(weights[:, None]).T.tocsr()
        correction = np.atleast_1d(spsolve((weighted @ A + prior).tocsc(), weighted @ target))
    small = Rotation.from_rotvec(correction.reshape(-1, 3)).as_matrix()
    return {step: small[n] @ turn.R_current_previous for n, (step, turn) in enumerate(turns.items())}
