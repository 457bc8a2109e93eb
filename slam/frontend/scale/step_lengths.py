"""Joint estimation of the lengths of all steps and of the drifting unit of learned depth.

A monocular step has a direction and no length. Three measurements give the length: points triangulated by two steps
that share a frame give the ratio of both lengths; the road's homography gives it in camera heights; learned depth gives
it in a unit that drifts. A vehicle's acceleration bounds the change of speed. In logarithms all of them are linear in
the lengths ``x`` and the unit's deviation ``b``, with ``t`` the duration of a step:

    x_k - x_{k-1} = ratio_k        x_k = road_k        x_k - b_k = learned_k        b_k - b_{k-1} = 0
    x_k - x_{k-1} = log(t_k / t_{k-1})

solved for the whole drive by robust least squares, whose matrix is banded (``docs/design/scale-and-lengths.md``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from slam.frames import Ends
from slam.frontend.visual.motion import Motion
from slam.geometry.robust import running_median
from slam.geometry.se3 import FloatArray

_ITERATIONS = 20
_HUBER_ITERATIONS = 5
_HUBER_K = 1.345
_MOST_CORRELATED = 0.999
# sigmas of logarithms: of a length by learned depth, measured on drives with truth, and least of the ratio of two steps
_LEARNED_SIGMA, _RATIO_SIGMA = 0.1, 0.004
OUTLIER_SIGMAS = 2.0  # residual at which the robust weight of a measurement is one half
_RATIO_WIDENING = 1.5  # factor on the sigma of a ratio measured by triangulated points
# factor on the sigma of a length by learned depth where the road gives it too, whose errors fewer neighbours share
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


@dataclass(frozen=True)
class StepLengths:
    """``length`` ``(S,)`` of each step and its ``relative_sigma`` ``(S,)``, NaN without a measurement.

    Errors of steps that share a ratio are correlated: along the drive their sum grows as that of independent errors of
    ``relative_correlated_sigma`` ``(S,)``. ``unit_correction`` ``(S,)`` times the prior unit of learned depth
    is its unit near that step. ``contradicted`` ``(S,)`` marks steps whose length is not what learned depth says, or
    changes from the step before as no vehicle's does.
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


def solve_lengths(evidence: StepEvidence) -> StepLengths:
    """Robust least squares on all evidence: Huber weights first, then Cauchy weights against outliers."""
    steps = len(evidence.learned)
    lengths, units = 2 * np.arange(steps), 2 * np.arange(steps) + 1
    ratio_sigma = np.hypot(_RATIO_WIDENING * evidence.ratio_sigma, _RATIO_SIGMA)
    learned_sigma = _LEARNED_SIGMA * np.where(np.isfinite(evidence.absolute), _BESIDE_ROAD, 1.0)
    ones = np.ones(steps)
    zero = np.full(steps, 2 * steps)  # behind the last state
    # state[plus] - state[minus] = value, with a sigma: plus, minus, value, sigma
    parts = [
        (lengths[1:], lengths[:-1], evidence.ratio[1:], ratio_sigma[1:]),
        (lengths, zero, evidence.absolute, evidence.absolute_sigma),
        (lengths, units, evidence.learned, learned_sigma),
        (lengths[1:], lengths[:-1], evidence.steady[1:], evidence.steady_sigma[1:]),
        (units[1:], units[:-1], 0.0 * ones[1:], _UNIT_WALK_SIGMA * ones[1:]),
        # one prior on the unit of the whole drive, divided among its steps
        (units, zero, 0.0 * ones, _UNIT_SIGMA * np.sqrt(steps) * ones),
    ]
    measured = np.zeros(2 * steps, dtype=bool)
    for state_of, _, value, _ in parts[:3]:
        measured[state_of[np.isfinite(value)]] = True
    idle = np.where(measured | (np.arange(2 * steps) % 2 == 1), 0.0, 1.0)
    plus, minus, value, sigma = (np.concatenate(column) for column in zip(*parts, strict=True))
    known = np.isfinite(value) & np.isfinite(sigma)
    plus, minus, value, sigma = plus[known], minus[known], value[known], sigma[known]
    state, weights = np.zeros(2 * steps + 1), np.ones(len(value))
    for iteration in range(_ITERATIONS):
        information, right = _normal_equations(plus, minus, value, weights / sigma**2, idle)
        state[:-1] = solveh_banded(information, right)
        residual = np.abs((state[plus] - state[minus] - value) / sigma)
        robust = 1.0 / (1.0 + (residual / OUTLIER_SIGMAS) ** 2)
        weights = 1.0 / np.maximum(residual / _HUBER_K, 1.0) if iteration < _HUBER_ITERATIONS else robust
    log_length, log_unit = state[lengths], state[units]
    of_measured = np.where(measured[lengths], 1.0, np.nan)
    sigmas, correlations = marginals(information)
    correlated_sigmas = _CORRELATED_WIDENING * sigmas * np.sqrt((1.0 + correlations) / (1.0 - correlations))
    sigmas, correlated_sigmas = of_measured * sigmas, of_measured * correlated_sigmas
    by_learned = (evidence.learned + log_unit - log_length) / _LEARNED_SIGMA
    by_speed = (np.diff(log_length, prepend=np.nan) - evidence.steady) / (evidence.steady_sigma + _LENGTH_SIGMA)
    contradicted = (np.abs(by_learned) > _CONTRADICTION_SIGMAS) | (np.abs(by_speed) > _CONTRADICTION_SIGMAS)
    return StepLengths(of_measured * np.exp(log_length), sigmas, correlated_sigmas, np.exp(log_unit), contradicted)


def marginals(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Marginals of every length from the upper band ``(3, 2 S)`` of an information matrix.

    Each length is followed by the unit of its step. The matrix is block tridiagonal by step, so the marginal
    information from all earlier and from all later steps is each a chain of 2x2 Schur complements.

    Returns:
        Sigmas ``(S,)``, and correlations ``(S,)`` with the neighbours' lengths in [0, 1), the mean of both sides.
        Errors whose correlation falls by a factor r from step to step have a sum of ``(1 + r) / (1 - r)`` times the
        variance of independent ones.
    """
    neighbour, within, main = (band.reshape(-1, 2) for band in information)
    own = np.stack([main[:, 0], within[:, 1], within[:, 1], main[:, 1]], axis=1)
    before, after = _from_before(own, neighbour[1:]), _from_before(own[::-1], neighbour[:0:-1])[::-1]
    sigmas = np.sqrt(np.linalg.inv((before + after - own).reshape(-1, 2, 2))[:, 0, 0])
    coupling = np.zeros((len(own) - 1, 2, 2))  # of a step and the next
    coupling[:, 0, 0], coupling[:, 1, 1] = neighbour[1:].T
    earlier, later = before[:-1].reshape(-1, 2, 2), after[1:].reshape(-1, 2, 2)
    pairs = np.block([[earlier, coupling], [coupling, later]])  # (S - 1, 4, 4)
    coupled = np.clip(np.linalg.inv(pairs)[:, 0, 2] / (sigmas[:-1] * sigmas[1:]), 0.0, _MOST_CORRELATED)
    ends = coupled[:1], coupled[-1:]
    return np.asarray(sigmas), 0.5 * (np.concatenate([ends[0], coupled]) + np.concatenate([coupled, ends[1]]))


def _from_before(own: FloatArray, coupling: FloatArray) -> FloatArray:
    """Information ``(S, 4)`` on each step from its ``own`` ``(S, 4)``, matrices row by row, and from all steps before.

    ``coupling`` ``(S - 1, 2)`` is the diagonal of each block between a step and the next.
    """
    chain = own[:1].tolist()
    for (a, b, _, d), (of_length, of_unit) in zip(own[1:].tolist(), coupling.tolist(), strict=True):
        a_before, b_before, _, d_before = chain[-1]
        determinant = a_before * d_before - b_before**2
        b += of_length * of_unit * b_before / determinant
        chain.append([a - of_length**2 * d_before / determinant, b, b, d - of_unit**2 * a_before / determinant])
    return np.array(chain)


def _normal_equations(
    plus: NDArray[np.intp], minus: NDArray[np.intp], value: FloatArray, weights: FloatArray, idle: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The upper band ``(3, N)`` of the weighted normal matrix with ``idle`` on its diagonal, and the right side.

    Of equations ``state[plus] - state[minus] = value``, ``(M,)`` each; the place behind the last state is zero. None
    ties states that are more than two places apart.
    """

    def added(places: NDArray[np.intp], values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(places, values, len(idle) + 1)[: len(idle)], np.float64)

    later, apart = np.maximum(plus, minus), np.abs(plus - minus)
    off_diagonal = (-added(later, np.where(apart == distance, weights, 0.0)) for distance in (2, 1))
    diagonal = idle + added(plus, weights) + added(minus, weights)
    right = added(plus, weights * value) - added(minus, weights * value)
    return np.array([*off_diagonal, diagonal]), right
