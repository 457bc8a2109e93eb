"""Joint estimation of the lengths of all steps and of the drifting unit of learned depth.

A monocular step has a direction and no length. Three measurements give the length: points triangulated by two steps
that share a frame give the ratio of both lengths; the road's homography gives it in camera heights; learned depth gives
it in a unit that drifts. A vehicle's acceleration bounds the change of speed. In logarithms all of them are linear in
the lengths ``x`` and the unit's deviation ``b``, with ``t`` the duration of a step:

    x_k - x_{k-1} = ratio_k        x_k = road_k        x_k - b_k = learned_k        b_k - b_{k-1} = 0
    x_k - x_{k-1} = log(t_k / t_{k-1})

solved for the whole drive by robust sparse least squares (``docs/design/scale-and-lengths.md``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array
from scipy.sparse.linalg import spsolve

from slam.config.sections import LengthConfig
from slam.frames import Ends
from slam.frontend.visual.motion import Motion
from slam.geometry.robust import running_median
from slam.geometry.se3 import FloatArray

_ITERATIONS = 20
_HUBER_ITERATIONS = 5
_HUBER_K = 1.345
_MOST_CORRELATED = 0.999
_RATIO_WIDENING = 1.5  # factor on the sigma of a ratio measured by triangulated points
# factor on the sigma of a length by learned depth where the road gives it too: that has no errors that neighbours share
_BESIDE_ROAD = 4.0
_UNIT_WALK_SIGMA = 0.003  # sigma per step of the random walk of learned depth's scale
_UNIT_SIGMA = 0.2  # sigma of that scale by the learned ground plane
_ACCELERATION_SIGMA = 3.0  # of a vehicle, in camera heights: 5 m/s2 at 1.65 m
_SPEED_STEPS = 11  # window over which the speed is averaged that a change is compared with
_LENGTH_SIGMA = 0.05  # of a single length where it is compared with the one before
_CONTRADICTION_SIGMAS = 5.0
_CORRELATED_WIDENING = 1.5  # factor on the sigmas in the pose graph, for errors correlated along the road


@dataclass(frozen=True)
class StepEvidence:
    """Measurements of S steps, logarithms and their sigmas ``(S,)`` each, NaN where there is none.

    ``ratio`` is the length over that of the step before; ``absolute`` the length in the mode's unit; ``learned``
    the length by learned depth, already in the prior unit of the networks; ``steady`` the length over that of
    the step before at constant speed, with the sigma that a vehicle's acceleration gives it.
    """

    ratio: FloatArray
    ratio_sigma: FloatArray
    absolute: FloatArray
    absolute_sigma: FloatArray
    learned: FloatArray
    steady: FloatArray
    steady_sigma: FloatArray

    @classmethod
    def empty(cls, steps: int) -> StepEvidence:
        """Without a measurement."""
        return cls(*(np.full(steps, np.nan) for _ in range(7)))

    def without_contradicted(self, factor: float) -> StepEvidence:
        """The same without absolute lengths that differ from learned ones by more than ``factor``."""
        contradicted = np.abs(self.absolute - self.learned) > np.log(factor)
        return replace(self, absolute=np.where(contradicted, np.nan, self.absolute))


@dataclass(frozen=True)
class StepLengths:
    """``length`` ``(S,)`` of each step and its ``relative_sigma`` ``(S,)``, NaN without a measurement.

    Steps linked by ratios have correlated errors. Independent errors of ``relative_correlated_sigma`` ``(S,)``
    would add up along the drive as those do. ``unit_correction`` ``(S,)`` times the prior unit of learned depth is its
    unit near that step. ``contradicted`` ``(S,)`` marks steps whose length is not what learned depth says, or changes
    from the step before as no vehicle's does.
    """

    length: FloatArray
    relative_sigma: FloatArray
    relative_correlated_sigma: FloatArray
    unit_correction: FloatArray
    contradicted: NDArray[np.bool_]


def gather_evidence(
    links: Sequence[Ends],
    motions: Mapping[Ends, Motion],
    absolute: Mapping[Ends, tuple[float, float]],
    prior_unit: FloatArray,
    camera_height: float = 1.0,
) -> StepEvidence:
    """All measurements of the lengths of a drive's steps, one row a link.

    Args:
        links: consecutive steps.
        motions: the triangulated ones.
        absolute: length in the mode's unit, and its relative sigma.
        prior_unit: that unit per unscaled length near each frame ``(N,)``.
        camera_height: in that unit.
    """
    evidence = StepEvidence.empty(len(links))
    seconds = np.full(len(links), np.nan)
    before: Motion | None = None
    for row, ends in enumerate(links):
        motion = motions.get(ends)
        if motion is not None:
            seconds[row] = motion.seconds
            evidence.learned[row] = np.log(motion.length_unscaled * prior_unit[ends[0]])
            if ends in absolute:
                length, evidence.absolute_sigma[row] = absolute[ends]
                evidence.absolute[row] = np.log(length)
            if before is not None and motion.length_ratio is not None:
                evidence.ratio[row], evidence.ratio_sigma[row] = motion.length_ratio
        before = motion
    evidence.steady[1:] = np.log(seconds[1:] / seconds[:-1])
    speed = np.exp(running_median(evidence.learned - np.log(seconds), _SPEED_STEPS))
    changes = _ACCELERATION_SIGMA * camera_height * 0.5 * (seconds[1:] + seconds[:-1])
    evidence.steady_sigma[1:] = changes / speed[1:]
    return evidence


def solve_lengths(evidence: StepEvidence, config: LengthConfig) -> StepLengths:
    """Robust least squares on all evidence: Huber weights first, then Cauchy weights against outliers."""
    steps = len(evidence.learned)
    lengths, units = np.arange(steps), steps + np.arange(steps)
    ratio_sigma = np.hypot(_RATIO_WIDENING * evidence.ratio_sigma, config.ratio_sigma)
    learned_sigma = config.learned_sigma * np.where(np.isfinite(evidence.absolute), _BESIDE_ROAD, 1.0)
    ones = np.ones(steps)
    rows = [
        _Rows(lengths[1:], lengths[:-1], evidence.ratio[1:], ratio_sigma[1:]),
        _Rows(lengths, None, evidence.absolute, evidence.absolute_sigma),
        _Rows(lengths, units, evidence.learned, learned_sigma),
        _Rows(lengths[1:], lengths[:-1], evidence.steady[1:], evidence.steady_sigma[1:]),
        _Rows(units[1:], units[:-1], 0.0 * ones[1:], _UNIT_WALK_SIGMA * ones[1:]),
        # one prior on the unit of the whole drive, divided among its steps
        _Rows(units, None, 0.0 * ones, _UNIT_SIGMA * np.sqrt(steps) * ones),
    ]
    A, target = _whitened(rows, 2 * steps)
    measured = np.zeros(steps, dtype=bool)
    for row in rows[:3]:
        measured[row.plus[np.isfinite(row.value)]] = True
    idle = csr_array((np.where(np.concatenate([measured, ones > 0]), 0.0, 1.0), (range(2 * steps),) * 2))
    state, weights = np.zeros(2 * steps), np.ones(len(target))
    for iteration in range(_ITERATIONS):
        weighted = A.multiply(weights[:, None]).T.tocsr()
        information = (weighted @ A + idle).tocsc()
        state = np.atleast_1d(spsolve(information, weighted @ target))
        residual = np.abs(A @ state - target)
        robust = 1.0 / (1.0 + (residual / config.outlier_sigmas) ** 2)
        weights = 1.0 / np.maximum(residual / _HUBER_K, 1.0) if iteration < _HUBER_ITERATIONS else robust
    known = np.where(measured, 1.0, np.nan)
    sigmas, correlations = marginals(information, steps)
    correlated_sigmas = _CORRELATED_WIDENING * sigmas * np.sqrt((1.0 + correlations) / (1.0 - correlations))
    sigmas, correlated_sigmas = known * sigmas, known * correlated_sigmas
    by_learned = (evidence.learned + state[steps:] - state[:steps]) / config.learned_sigma
    by_speed = (np.diff(state[:steps], prepend=np.nan) - evidence.steady) / (evidence.steady_sigma + _LENGTH_SIGMA)
    contradicted = (np.abs(by_learned) > _CONTRADICTION_SIGMAS) | (np.abs(by_speed) > _CONTRADICTION_SIGMAS)
    return StepLengths(known * np.exp(state[:steps]), sigmas, correlated_sigmas, np.exp(state[steps:]), contradicted)


def marginals(information: csc_array, steps: int) -> tuple[FloatArray, FloatArray]:
    """Marginals of every length from an information matrix ``(2 S, 2 S)`` of lengths, then units.

    The matrix is block tridiagonal by step, so the marginal information from all earlier and from all later steps is
    each a chain of 2x2 Schur complements.

    Returns:
        Sigmas ``(S,)``, and correlations ``(S,)`` with the neighbours' lengths in [0, 1), the mean of both sides.
        Errors whose correlation falls by a factor r from step to step have a sum of ``(1 + r) / (1 - r)`` times the
        variance of independent ones.
    """
    main, neighbour = information.diagonal(), information.diagonal(1)
    own = np.zeros((steps, 2, 2))
    own[:, 0, 0], own[:, 1, 1] = main[:steps], main[steps:]
    own[:, 0, 1] = own[:, 1, 0] = information.diagonal(steps)
    coupling = np.zeros((steps, 2, 2))  # of a step and the next
    coupling[:-1, 0, 0], coupling[:-1, 1, 1] = neighbour[: steps - 1], neighbour[steps:]
    before, after = own.copy(), own.copy()
    for k in range(1, steps):
        before[k] -= coupling[k - 1] @ np.linalg.inv(before[k - 1]) @ coupling[k - 1]
        after[-k - 1] -= coupling[-k - 1] @ np.linalg.inv(after[-k]) @ coupling[-k - 1]
    sigmas = np.sqrt(np.linalg.inv(before + after - own)[:, 0, 0])
    pairs = np.block([[before[:-1], coupling[:-1]], [coupling[:-1], after[1:]]])  # (S - 1, 4, 4)
    coupled = np.clip(np.linalg.inv(pairs)[:, 0, 2] / (sigmas[:-1] * sigmas[1:]), 0.0, _MOST_CORRELATED)
    ends = coupled[:1], coupled[-1:]
    return np.asarray(sigmas), 0.5 * (np.concatenate([ends[0], coupled]) + np.concatenate([coupled, ends[1]]))


@dataclass(frozen=True)
class _Rows:
    """Equations ``state[plus] - state[minus] = value``, each with its sigma; those with NaN are left out."""

    plus: np.ndarray[tuple[int], np.dtype[np.int64]]
    minus: np.ndarray[tuple[int], np.dtype[np.int64]] | None
    value: FloatArray
    sigma: FloatArray


def _whitened(rows: list[_Rows], states: int) -> tuple[csr_array, FloatArray]:
    """Matrix and right side of all equations divided by their sigmas."""
    columns, entries, places, values = [], [], [], []
    count = 0
    for row in rows:
        known = np.isfinite(row.value) & np.isfinite(row.sigma)
        place = count + np.arange(int(known.sum()))
        count += len(place)
        for side, sign in ((row.plus, 1.0), (row.minus, -1.0)):
            if side is not None:
                places.append(place)
                columns.append(side[known])
                entries.append(sign / row.sigma[known])
        values.append(row.value[known] / row.sigma[known])
    A = coo_array((np.concatenate(entries), (np.concatenate(places), np.concatenate(columns))), shape=(count, states))
    return A.tocsr(), np.concatenate(values)
