"""The lengths of all steps of a run.

A monocular step has a direction and no length. Three measurements give the length: points
triangulated by two steps that share a frame give the ratio of both lengths; the road's homography
gives it in camera heights; learned depth gives it in a unit that drifts. A vehicle's acceleration
bounds the change of speed. In logarithms all of them are linear in the lengths ``x`` and the unit's
deviation ``b``, with ``t`` the duration of a step:

    x_k - x_{k-1} = ratio_k        x_k = road_k        x_k - b_k = learned_k        b_k - b_{k-1} = 0
    x_k - x_{k-1} = log(t_k / t_{k-1})

solved for the whole drive by robust least squares, whose matrix is banded
(``docs/design/scale-and-lengths.md``).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from scipy.linalg import cholesky_banded, solveh_banded
from scipy.ndimage import convolve1d

from slam.config.sections import ScaleMode
from slam.frames import Ends, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.road import RoadStep
from slam.frontend.visual.motion import Motion, links
from slam.geometry.robust import difference_equations, mad_sigma, median, rms, running_median
from slam.geometry.se3 import BoolArray, FloatArray, length_of
from slam.runtime.errors import Failed

LengthUnit = Literal["metres", "camera heights", "no metric unit", "the networks' own unit"]

logger = logging.getLogger(__name__)
# of the frames, half of which have learned depth; fewer see a floor or a table now and then
_LEAST_ROAD = 1 / 3
_MAX_CONTRADICTION = 2.5  # largest factor between a measured length and that by learned depth
_REJECTION_SIGMAS = 3.0  # distance from the median beyond which a frame is left out
MIN_FRAMES = 5  # least number of usable frames of a scale
_ITERATIONS = 20
_HUBER_ITERATIONS = 5
_HUBER_K = 1.345
_IDLE = 1e-6  # information on a length that nothing measures
_MOST_CORRELATED = 0.999
# sigmas of logarithms: of a length by learned depth, measured on drives with truth, and least of
# the ratio of two steps
_LEARNED_SIGMA, _RATIO_SIGMA = 0.1, 0.004
OUTLIER_SIGMAS = 2.0  # residual at which the robust weight of a measurement is one half
_RATIO_WIDENING = 1.5  # factor on the sigma of a ratio measured by triangulated points
# factor on the sigma of a length by learned depth where the road gives it too, whose errors fewer
# neighbours share
_BESIDE_ROAD = 4.0
_UNIT_WALK_SIGMA = 0.003  # sigma per step of the random walk of learned depth's scale
_FIRST_WALK = 100.0  # factor on it in the first iteration, halved in each
# steps over which learned lengths are compared with those by points, and their usual difference
_NOISE_STEPS, _USUAL_NOISE = 20, 0.08
_MOST_NOISE_BESIDE_ROAD = 2.0  # of learned lengths that a length by the road may contradict
# sigmas of that scale by the learned ground planes: of all, that share an error, and of one frame's change
_UNIT_SIGMA, _PLANE_SIGMA = 0.2, 0.1
_ACCELERATION_SIGMA = 3.0  # of a vehicle, in camera heights: 5 m/s2 at 1.65 m
_RATE_STEPS = 101  # around a step that was not measured, whose frames are as long as theirs
_SPEED_STEPS = 11  # window over which the speed is averaged that a change is compared with
_LENGTH_SIGMA = 0.05  # of a single length where it is compared with the one before
_CONTRADICTION_SIGMAS = 5.0
# factor on the sigmas in the pose graph, for errors correlated along the road
_CORRELATED_WIDENING = 1.5


@dataclass(frozen=True)
class ScaleEstimate:
    """``value`` times an unscaled length is a length in the mode's unit.

    ``spread`` is the relative sigma of the values of single frames.
    """

    value: float
    spread: float
    frames_used: int


@dataclass(frozen=True)
class Unit:
    """What a scale mode knows.

    Attributes:
        mode: resolved.
        stated_m: the camera's height above the road, of modes by it; None where unknown.
        metres: per unit of an odometry ``(N, 4, 4)``, of modes that measure them there; else None.
    """

    mode: ScaleMode
    stated_m: float | None = None
    metres: Callable[[FloatArray], ScaleEstimate | Failed] | None = None

    @property
    def by_lidar(self) -> bool:
        """Whether steps by LiDAR give all lengths."""
        return self.mode == "lidar"

    @property
    def by_gps(self) -> bool:
        """Whether a GPS track gives all lengths."""
        return self.mode == "gps"

    @property
    def gives_metres(self) -> bool:
        """Whether lengths are to be metres."""
        return self.mode != "none"


class StepLength(NamedTuple):
    """A length, its relative sigma, and the sigma of independent errors that add up as its correlated ones do."""

    value: float
    relative_sigma: float
    relative_correlated_sigma: float


@dataclass(frozen=True)
class Scale:
    """``per_frame`` ``(N,)`` times an unscaled length near that frame is a length in ``unit``.

    ``lengths`` of the steps that image geometry measured are in ``unit``. ``estimate`` is that of
    the mode's unit, or why there is none. ``contradicted`` steps have the change of the logarithm of
    the speed from the steps before to those after, which a unit that leaps makes.
    """

    mode: ScaleMode
    estimate: ScaleEstimate | Failed
    per_frame: FloatArray
    lengths: Mapping[Ends, StepLength]
    unit: LengthUnit
    contradicted: Mapping[Ends, float]

    @property
    def is_metric(self) -> bool:
        """Whether lengths are metres."""
        return self.unit == "metres"

    @property
    def unit_name(self) -> str | None:
        """``m``, with mode none ``unit``; None where metres were not found."""
        return "m" if self.is_metric else self.unit if self.mode == "none" else None

    def scaled(self, measured: RelativePose) -> RelativePose:
        """An unscaled measurement in the mode's unit at its first frame."""
        return measured.scaled(float(self.per_frame[min(measured.ends)]))


def find_scale(unit: Unit, drive: Drive, lidar_steps: Sequence[RelativePose] = ()) -> Scale:
    """All lengths of a run in metres, or in camera heights where no height is known.

    Without a road in most frames, the planes that were found give no unit that means anything.

    Args:
        unit: by the scale mode.
        drive: completed.
        lidar_steps: steps by LiDAR, metres.
    """
    motions, frames = drive.triangulated, len(drive)
    lidar_steps = lidar_steps if unit.by_lidar else ()
    height_m = height_by_lidar(lidar_steps, drive) or unit.stated_m
    height = height_m or 1.0
    absolute = _absolute_lengths(drive.road_steps, height, lidar_steps)
    by_planes = scale_from_road(drive.measured.roads, height)
    steps = links(motions, frames)
    firsts = [first for first, _ in steps]
    if isinstance(by_planes, Failed):
        both = motions.keys() & absolute.keys()
        ratios = [absolute[ends][0] / motions[ends].length_unscaled for ends in both]
        prior_unit = median(ratios) if ratios else 1.0
    else:
        prior_unit = by_planes.value
    evidence = gather_evidence(steps, drive.steps, absolute, prior_unit)
    if not isinstance(by_planes, Failed):
        # a car ahead taken for the road for seconds would outweigh all other measurements
        most = np.log(_MAX_CONTRADICTION) * min(evidence.learned_noise, _MOST_NOISE_BESIDE_ROAD)
        evidence.absolute[np.abs(evidence.absolute - evidence.learned) > most] = np.nan
        planes = _ratios(drive.measured.roads, height)[firsts]
        evidence.plane[:] = np.log(planes / by_planes.value)
        over_prior = evidence.absolute - evidence.learned
        if np.isfinite(over_prior).any():  # rain biases the learned plane: its changes alone count
            evidence.plane[:] += np.nanmedian(over_prior)
    solved = solve_lengths(evidence, height)
    row_at = np.searchsorted(firsts, np.arange(frames), side="right") - 1
    unit_correction = solved.unit_correction
    if drive.by_keyframes:  # maps have the unit of learned depth, one along the drive
        unit_correction = np.full_like(unit_correction, np.median(unit_correction))
    per_frame = prior_unit * unit_correction[row_at]
    misfit = np.abs(evidence.absolute - np.log(solved.length))
    used = int(np.isfinite(misfit).sum())
    estimate = by_planes
    is_metric = height_m is not None or bool(lidar_steps)
    named: LengthUnit = "metres" if is_metric else "camera heights"
    if used >= MIN_FRAMES:
        spread = mad_sigma(misfit[np.isfinite(misfit)])
        estimate = ScaleEstimate(median(per_frame), spread, used)
    elif isinstance(by_planes, Failed):
        named = "the networks' own unit"
        logger.warning("no scale (%s): lengths stay in %s", by_planes.reason, named)
    # by learned depth, or by the homography of steps
    with_road = max(used, 0 if isinstance(by_planes, Failed) else by_planes.frames_used)
    if named == "camera heights" and with_road < _LEAST_ROAD * frames:
        named = "no metric unit"
    values = solved.length, solved.relative_sigma, solved.relative_correlated_sigma
    rows = zip(steps, np.transpose(values).tolist(), strict=True)
    lengths = {ends: StepLength(*row) for ends, row in rows if np.isfinite(row[0])}
    log_speed = running_median(np.log(solved.length / evidence.seconds), _SPEED_STEPS)
    # from the window that ends before each step to that which begins with it
    padded = np.pad(log_speed, (_SPEED_STEPS // 2 + 1, _SPEED_STEPS // 2), mode="edge")
    leaps = np.nan_to_num(padded[_SPEED_STEPS:] - padded[:-_SPEED_STEPS]).tolist()
    contradicted = {steps[row]: leaps[row] for row in np.flatnonzero(solved.contradicted)}
    return Scale(unit.mode, estimate, per_frame, lengths, named, contradicted)


def _absolute_lengths(
    road_steps: Mapping[Ends, RoadStep], unit: float, lidar_steps: Sequence[RelativePose]
) -> dict[Ends, tuple[float, float]]:
    """Lengths by the road, in ``unit`` a camera height, or by LiDAR, and their relative sigmas."""
    absolute = {
        ends: (unit * road.length_heights, road.relative_sigma) for ends, road in road_steps.items()
    }
    for pose in lidar_steps:
        length = length_of(pose.T_from_to[:3, 3])
        if length > 0:
            absolute[pose.ends] = length, float(pose.sigmas[3]) / length
    return absolute


def height_by_lidar(lidar_steps: Sequence[RelativePose], drive: Drive) -> float | None:
    """The camera's height from steps measured by LiDAR and the road, or else by learned planes; None without both."""
    metres = {pose.ends: length_of(pose.T_from_to[:3, 3]) for pose in lidar_steps}
    roads = drive.road_steps
    heights = [metres[ends] / roads[ends].length_heights for ends in roads if ends in metres]
    if not heights:
        for ends, motion in drive.triangulated.items():
            plane = drive.measured.roads[ends[0]]
            if ends in metres and plane is not None:
                heights.append(metres[ends] / motion.length_unscaled * plane)
    return median(heights) if heights else None


def scale_from_road(roads: Sequence[float | None], height: float = 1.0) -> ScaleEstimate | Failed:
    """Unit of the camera's ``height`` per unscaled length: metres, or camera heights where it is 1.

    The median over the frames without outliers, which are many MADs away.
    """
    ratios = _ratios(roads, height)
    logarithms = np.log(ratios[np.isfinite(ratios)])
    if len(logarithms) < MIN_FRAMES:
        return Failed(f"only {len(logarithms)} frames measure the scale, {MIN_FRAMES} are needed")
    deviations = np.abs(logarithms - np.median(logarithms))
    kept = logarithms[deviations <= _REJECTION_SIGMAS * mad_sigma(deviations) + 1e-12]
    spread = mad_sigma(kept - np.median(kept))
    return ScaleEstimate(float(np.exp(np.median(kept))), spread, len(kept))


def _ratios(roads: Sequence[float | None], height: float) -> FloatArray:
    """The camera's height over that above each ground plane ``(N,)``, NaN without one."""
    return height / np.array(roads, np.float64)


@dataclass(frozen=True)
class StepEvidence:
    """Measurements of S steps, logarithms and their sigmas ``(S,)`` each, NaN where there is none.

    ``ratio`` is the length over that of the step before; ``absolute`` the length in the mode's
    unit; ``learned`` the length by learned depth, already in the prior unit of the networks, and
    ``plane`` that unit by the ground plane in learned depth, over the prior.
    ``seconds`` are those of each step, also where it was not measured, NaN where the camera
    stood or hardly moved.
    """

    ratio: FloatArray
    ratio_sigma: FloatArray
    absolute: FloatArray
    absolute_sigma: FloatArray
    learned: FloatArray
    plane: FloatArray
    seconds: FloatArray

    @cached_property
    def learned_noise(self) -> float:
        """How much more learned lengths err than on the roads that the network knows, at least 1.

        By how they change against the lengths that points give, over some steps.
        """
        change = np.diff(self.learned) - self.ratio[1:]
        over_steps = convolve1d(change, np.ones(_NOISE_STEPS), mode="constant", cval=np.nan)
        whole = over_steps[np.isfinite(over_steps)]
        return max(rms(whole) / _USUAL_NOISE, 1.0) if len(whole) >= _NOISE_STEPS else 1.0

    def steady_sigma(self, log_length: FloatArray, camera_height: float) -> FloatArray:
        """By how much a vehicle's acceleration changes the logarithm of its speed from step to step ``(S - 1,)``.

        Args:
            log_length: of the steps ``(S,)``, which give the speed, NaN where unknown.
            camera_height: in the mode's unit.
        """
        log_speed = running_median(log_length - np.log(self.seconds), _SPEED_STEPS)
        is_known = np.isfinite(log_speed)
        speed = np.exp(np.where(is_known, log_speed, median(log_speed[is_known])))
        duration = 0.5 * (self.seconds[1:] + self.seconds[:-1])
        change = _ACCELERATION_SIGMA * camera_height * duration
        return change / np.maximum(speed[1:], speed[:-1])

    def contradicted(
        self, log_length: FloatArray, log_unit: FloatArray, speed_sigma: FloatArray
    ) -> BoolArray:
        """Which lengths are not what learned depth says, or change as no vehicle's does ``(S,)``.

        Args:
            log_length: solved ``(S,)``.
            log_unit: of learned depth over the prior ``(S,)``.
            speed_sigma: by `steady_sigma` ``(S - 1,)``.
        """
        unit_before = np.concatenate([log_unit[:1], log_unit[:-1]])
        by_learned = self.learned + unit_before - log_length
        by_learned /= self.learned_noise * _LEARNED_SIGMA
        change = np.diff(log_length) - np.diff(np.log(self.seconds))
        by_speed = np.concatenate([[np.nan], change / np.hypot(speed_sigma, _LENGTH_SIGMA)])
        worst = np.fmax(np.abs(by_learned), np.abs(by_speed))
        return worst > _CONTRADICTION_SIGMAS

    @classmethod
    def empty(cls, steps: int) -> StepEvidence:
        """Without a measurement."""
        return cls(*(np.full(steps, np.nan) for _ in range(7)))


@dataclass(frozen=True)
class StepLengths:
    """``length`` ``(S,)`` of each step and its ``relative_sigma`` ``(S,)``, NaN without a measurement.

    Errors of steps that share a ratio are correlated: along the drive their sum grows as that of
    independent errors of ``relative_correlated_sigma`` ``(S,)``. ``unit_correction`` ``(S,)`` times
    the prior unit of learned depth is its unit near that step. ``contradicted`` ``(S,)`` marks
    steps whose length is not what learned depth says, or changes from the step before as no
    vehicle's does.
    """

    length: FloatArray
    relative_sigma: FloatArray
    relative_correlated_sigma: FloatArray
    unit_correction: FloatArray
    contradicted: BoolArray


def gather_evidence(
    links: Sequence[Ends],
    motions: Mapping[Ends, Motion],
    absolute: Mapping[Ends, tuple[float, float]],
    prior_unit: float,
) -> StepEvidence:
    """All measurements of the lengths of a drive's steps, one row a link.

    Args:
        links: consecutive steps.
        motions: the measured ones.
        absolute: length in the mode's unit, and its relative sigma.
        prior_unit: that unit per unscaled length.
    """
    evidence = StepEvidence.empty(len(links))
    before: Motion | None = None
    for row, ends in enumerate(links):
        motion = motions.get(ends)
        if motion is not None and motion.is_triangulated:
            evidence.seconds[row] = motion.seconds
            evidence.learned[row] = np.log(motion.length_unscaled * prior_unit)
            if ends in absolute:
                length, evidence.absolute_sigma[row] = absolute[ends]
                evidence.absolute[row] = np.log(length)
            if before is not None and motion.length_ratio is not None:
                evidence.ratio[row], evidence.ratio_sigma[row] = motion.length_ratio
        before = motion
    frames = np.array([last - first for first, last in links])
    usual = running_median(evidence.seconds / frames, _RATE_STEPS)
    is_missed = np.array([ends not in motions for ends in links])
    evidence.seconds[is_missed] = (usual * frames)[is_missed]
    return evidence


def solve_lengths(evidence: StepEvidence, camera_height: float = 1.0) -> StepLengths:
    """Robust least squares on all evidence: Huber weights first, then Cauchy weights against outliers.

    Of two explanations of a jump, that learned depth lost its unit is found before that a vehicle
    leapt: the walk of the unit begins wide.

    Args:
        evidence: of all steps.
        camera_height: in the mode's unit, by which a vehicle's acceleration is known.
    """
    steps = len(evidence.learned)
    lengths, units = 2 * np.arange(steps), 2 * np.arange(steps) + 1
    ratio_sigma = np.hypot(_RATIO_WIDENING * evidence.ratio_sigma, _RATIO_SIGMA)
    noise = evidence.learned_noise
    beside_road = np.where(np.isfinite(evidence.absolute), _BESIDE_ROAD, 1.0)
    ones = np.ones(steps)
    steady = np.diff(np.log(evidence.seconds))
    zero = np.full(steps, 2 * steps)  # behind the last state
    # state[plus] - state[minus] = value, with a sigma: plus, minus, value, sigma
    parts = [
        (lengths[1:], lengths[:-1], steady, evidence.steady_sigma(evidence.learned, camera_height)),
        (units[1:], units[:-1], 0.0 * ones[1:], noise * _UNIT_WALK_SIGMA * ones[1:]),
        (lengths[1:], lengths[:-1], evidence.ratio[1:], ratio_sigma[1:]),
        (lengths, zero, evidence.absolute, evidence.absolute_sigma),
        (lengths, units, evidence.learned, noise * _LEARNED_SIGMA * beside_road),
        (units, zero, evidence.plane, noise**2 * _PLANE_SIGMA * ones),
        # one prior on the unit of the whole drive, divided among its steps
        (units, zero, 0.0 * ones, _UNIT_SIGMA * np.sqrt(steps) * ones),
    ]
    measured = np.zeros(2 * steps, dtype=bool)
    for state_of, _, value, _ in parts[2:5]:
        measured[state_of[np.isfinite(value)]] = True
    idle = np.where(measured | (np.arange(2 * steps) % 2 == 1), 0.0, _IDLE)
    plus, minus, value, sigma = (np.concatenate(column) for column in zip(*parts, strict=True))
    of_speed, of_walk = slice(0, steps - 1), slice(steps - 1, 2 * steps - 2)
    # between steps without a common point, no vehicle leaves the bound of its acceleration
    is_bound = np.zeros(len(value), dtype=bool)
    is_bound[of_speed] = np.isnan(evidence.ratio[1:])
    known = np.isfinite(value) & np.isfinite(sigma)
    value[~known], sigma[~known] = 0.0, np.inf
    state, weights = np.zeros(2 * steps + 1), np.ones(len(value))
    for iteration in range(_ITERATIONS):
        weights[of_walk] /= max(_FIRST_WALK * 0.5**iteration, 1.0) ** 2
        information, right = difference_equations(plus, minus, value, weights / sigma**2, idle)
        state[:-1] = solveh_banded(information, right)
        speed_sigma = evidence.steady_sigma(state[lengths], camera_height)
        sigma[of_speed] = np.where(known[of_speed], speed_sigma, np.inf)
        residual = np.abs((state[plus] - state[minus] - value) / sigma)
        if iteration < _HUBER_ITERATIONS:
            weights = 1.0 / np.maximum(residual / _HUBER_K, 1.0)
        else:
            weights = 1.0 / (1.0 + (residual / OUTLIER_SIGMAS) ** 2)
        weights[is_bound] = 1.0
    log_length, log_unit = state[lengths], state[units]
    of_measured = np.where(measured[lengths], 1.0, np.nan)
    sigmas, correlations = marginals(information)
    correlated_sigmas = (
        _CORRELATED_WIDENING * sigmas * np.sqrt((1.0 + correlations) / (1.0 - correlations))
    )
    sigmas, correlated_sigmas = of_measured * sigmas, of_measured * correlated_sigmas
    contradicted = evidence.contradicted(log_length, log_unit, speed_sigma)
    return StepLengths(
        of_measured * np.exp(log_length), sigmas, correlated_sigmas, np.exp(log_unit), contradicted
    )


def marginals(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Marginals of every length from the upper band ``(3, 2 S)`` of an information matrix.

    Each length is followed by the unit of its step. The inverse is known inside the band from its
    last row back, by the Cholesky factor (Takahashi et al. 1973).

    Returns:
        Sigmas ``(S,)``, and correlations ``(S,)`` with the neighbours' lengths in [0, 1), the mean
        of both sides. Errors whose correlation falls by a factor r from step to step have a sum of
        ``(1 + r) / (1 - r)`` times the variance of independent ones.
    """
    second, first, main = cholesky_banded(information)
    factors = main**-2.0, np.append(first[1:], 0.0) / main, np.append(second[2:], [0.0, 0.0]) / main
    # covariances of each unknown with itself and the next two, from the last one back
    rows = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    for own, by_next, by_second in np.transpose(factors)[::-1].tolist():
        (of_second, _, _), (of_next, of_both, _) = rows[-2:]
        with_next = -by_next * of_next - by_second * of_both
        with_second = -by_next * of_both - by_second * of_second
        rows.append([own - by_next * with_next - by_second * with_second, with_next, with_second])
    variances, _, with_next_length = np.array(rows[:1:-2]).T
    sigmas = np.sqrt(variances)
    coupled = with_next_length[:-1] / (sigmas[:-1] * sigmas[1:])
    padded = np.pad(np.clip(coupled, 0.0, _MOST_CORRELATED), 1, mode="edge")
    return sigmas, 0.5 * (padded[1:] + padded[:-1])
