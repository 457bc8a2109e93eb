"""The pose network's snippets as relative-pose factors, and as the raw trajectory chained from them.

With calibrated noise (`erfsfm.pose_noise`) each pair of frames gets one factor: the mean of its measurements by
overlapping snippets, with the correlation of their errors. On the drive this noise is scaled to the
disagreement with image geometry, separately by turn rate, and the noise of image geometry is added. Errors have
heavier tails than normal ones and are correlated from snippet to snippet: the graph takes inflated sigmas for that
(``docs/design/noise-and-the-pose-graph.md``).

Without calibrated noise, sigmas are proportional to the motion. For a pair n frames apart the rotation sigma is
``rotation_sigma_deg * sqrt(n)``, the translation sigma ``translation_relative_sigma`` times the length plus a
floor (a ratio of the median one-frame step). Overlapping snippets measure a pair again from nearly the same images, so
their errors are taken as fully correlated: m measurements of one pair get their sigmas times sqrt(m) and count as one.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from scipy.spatial.transform import Rotation

from erfsfm.pose_noise import PairPose, PoseNoise, difference, pair_poses
from slam.frames import Ends, RelativePose, SnippetPoses
from slam.frontend.step_table import path_between, shortest_by_start
from slam.geometry.robust import mad_sigma, mad_sigmas
from slam.geometry.se3 import FloatArray, chain, invert, nearest_rotation
from slam.runtime.errors import SlamError

NETWORK_SOURCE = "network"
STUDENT_T_DOF = 12.0  # of the errors of measured steps and pairs: degrees of freedom of Student's t
# image geometry has errors too: sigmas are not scaled below this factor
_LEAST_SCALING = 0.3
_STRETCHES = 4

logger = logging.getLogger(__name__)
_NOISE_STEPS = 20  # steps also measured by image geometry, from which on the noise is estimated on this sequence
_TRANSLATION_FLOOR_RATIO = 0.05  # least translation sigma over the median one-frame step, without noise.yaml


@dataclass(frozen=True)
class UncalibratedNoise:
    """Noise of a pose network without ``noise.yaml``.

    Attributes:
        rotation_sigma_deg: of a step between neighbouring frames, degrees.
        translation_relative_sigma: over the length of the step.
    """

    rotation_sigma_deg: float = 0.3
    translation_relative_sigma: float = 0.1


def network_factors(snippets: Sequence[SnippetPoses], noise: UncalibratedNoise) -> list[RelativePose]:
    """Every direct pose of every snippet as ``T_source_target``, unscaled, with its noise."""
    multiplicity = Counter(_pair(source, s.target) for s in snippets for source in s.sources)
    floor = max(_TRANSLATION_FLOOR_RATIO * _median_step(snippets), 1e-9)
    factors = []
    for snippet in snippets:
        for source, T_source_target in zip(snippet.sources, snippet.T_source_target, strict=True):
            repeated = np.sqrt(multiplicity[_pair(source, snippet.target)])
            rotation = np.deg2rad(noise.rotation_sigma_deg) * np.sqrt(abs(snippet.target - source))
            length = float(np.linalg.norm(T_source_target[:3, 3]))
            translation = noise.translation_relative_sigma * length + floor
            sigmas = repeated * np.repeat([rotation, translation], 3)
            factors.append(RelativePose(source, snippet.target, T_source_target, sigmas, NETWORK_SOURCE))
    return factors


def calibrated_factors(
    snippets: Sequence[SnippetPoses], geometric: Sequence[RelativePose], noise: PoseNoise
) -> list[RelativePose]:
    """One factor for every pair of frames that snippets measured, ``T_first_last``, unscaled, with calibrated noise.

    Args:
        snippets: measured by the network.
        geometric: measured by image geometry, unscaled, with its full noise.
        noise: of this network, scaled by at least 20 common measurements. With fewer it says too little of this drive:
            only pairs that image geometry did not measure have factors.
    """
    pairs = pair_poses([(s.target, s.sources, s.T_source_target, s.residuals) for s in snippets])
    if not pairs:
        return []
    law = np.stack([noise.sigmas(pair) for pair in pairs])
    steps = {pose.ends: pose for pose in geometric}
    student_t_dof = STUDENT_T_DOF if len(steps) >= _NOISE_STEPS else math.inf
    from_geometry = _from_geometry(pairs, steps)
    scaling = _scaling(pairs, from_geometry / law, _NOISE_STEPS)
    redundant = np.isfinite(from_geometry).all(axis=1)
    usable = np.logical_or(np.isfinite(scaling).all(axis=1), ~redundant)
    sigmas = np.hypot(np.nan_to_num(scaling, nan=1.0) * law, _noise_of_geometry(pairs, steps))
    correlated_sigmas = _persistence(pairs, from_geometry / sigmas, _NOISE_STEPS) * sigmas
    return [
        RelativePose(pair.first, pair.last, pair.T_first_last, own, NETWORK_SOURCE, chained, student_t_dof)
        for pair, own, chained, use in zip(pairs, sigmas, correlated_sigmas, usable, strict=True)
        if use
    ]


def _from_geometry(pairs: Sequence[PairPose], steps: Mapping[Ends, RelativePose]) -> FloatArray:
    """Differences of pairs from chained steps of image geometry, ``(P, 6)``; NaN where a step was not measured."""
    differences = np.full((len(pairs), 6), np.nan)
    by_start = shortest_by_start(steps)
    paths = [path_between(by_start, pair.first, pair.last) for pair in pairs]
    rows = [k for k, path in enumerate(paths) if path is not None]
    if rows:
        T_geometric = np.stack([reduce(np.matmul, [steps[ends].T_from_to for ends in paths[k] or ()]) for k in rows])
        differences[rows] = difference(np.stack([pairs[k].T_first_last for k in rows]), T_geometric)
    return differences


def _scaling(pairs: Sequence[PairPose], whitened: FloatArray, least: int) -> FloatArray:
    """Factors ``(P, 6)`` on the sigmas of pairs, by ``whitened`` ``(P, 6)`` differences from image geometry.

    One for each distance in frames and, with enough measurements, each tertile of the turn rate; NaN with few.
    """
    scaling = np.full_like(whitened, np.nan)
    frames = np.array([pair.last - pair.first for pair in pairs])
    turn_rates = np.array([pair.turn for pair in pairs]) / frames
    measured = np.isfinite(whitened).all(axis=1)
    for distance in np.unique(frames):
        at_distance = frames == distance
        seen = at_distance & measured
        if seen.sum() < least:
            continue
        borders = np.quantile(turn_rates[seen], (1 / 3, 2 / 3)) if seen.sum() >= 3 * least else []
        third = np.searchsorted(borders, turn_rates)
        for which in np.unique(third[seen]):
            factors = mad_sigmas(whitened[seen & (third == which)])
            scaling[at_distance & (third == which)] = np.maximum(factors, _LEAST_SCALING)
            logger.info(
                "pose network's noise over %d frames, turn rate class %d of %d: times %s",
                distance,
                which + 1,
                len(borders) + 1,
                factors.round(2),
            )
    return scaling


def _persistence(pairs: Sequence[PairPose], whitened: FloatArray, least: int) -> FloatArray:
    """Factors ``(P, 6)`` on the sigmas of pairs for the correlation of their errors along the drive.

    The network's errors on neighbouring snippets are correlated. Sums of whitened errors over a quarter of the drive
    are compared with those of independent errors. With few measured pairs, errors are taken as constant over a
    quarter of the drive. Pairs of different distances in frames are redundant: each distance counts as one part.
    """
    factors = np.ones_like(whitened)
    frames = np.array([pair.last - pair.first for pair in pairs])
    distances = np.unique(frames)
    for distance in distances:
        at_distance = frames == distance
        errors = whitened[at_distance & np.isfinite(whitened).all(axis=1)]
        stretch = len(errors) // _STRETCHES
        if stretch < least:
            factors[at_distance] = np.sqrt(max(at_distance.sum() // _STRETCHES, 1))
            continue
        added = np.cumsum(np.vstack([np.zeros(6), errors]), axis=0)
        growth = mad_sigmas(added[stretch:] - added[:-stretch]) / np.sqrt(stretch)
        factors[at_distance] = np.maximum(growth, 1.0)
        logger.info("pose network's noise over %d frames, along the drive: times %s", distance, growth.round(2))
    return np.asarray(factors * np.sqrt(len(distances)))


def _noise_of_geometry(pairs: Sequence[PairPose], steps: Mapping[Ends, RelativePose]) -> FloatArray:
    """Sigmas ``(P, 6)`` of the chained geometric steps between the frames of pairs; median ones where not measured."""
    if not steps:
        return np.zeros((len(pairs), 6))
    by_start = shortest_by_start(steps)
    usual = np.median([steps[ends].sigmas for ends in by_start.values()], axis=0)
    sigmas = []
    for pair in pairs:
        between = []
        frame = pair.first
        while frame < pair.last:
            ends = by_start.get(frame, (frame, frame + 1))
            between.append(steps[ends].sigmas if ends in steps and ends[1] <= pair.last else usual)
            frame = ends[1]
        sigmas.append(np.linalg.norm(between, axis=0))
    return np.stack(sigmas)


def without_measured(factors: Sequence[RelativePose], geometric: Sequence[RelativePose]) -> list[RelativePose]:
    """The factors between whose frames image geometry did not measure every step.

    The network's errors on neighbouring snippets are correlated: beside a geometric factor of the same step, many of
    its factors would count as many independent measurements, where they are one less accurate one.
    """
    by_start = shortest_by_start(pose.ends for pose in geometric)
    return [factor for factor in factors if path_between(by_start, *sorted(factor.ends)) is None]


def measured_noise(snippets: Sequence[SnippetPoses], geometric: Sequence[RelativePose]) -> UncalibratedNoise:
    """The noise of this network on this drive, by comparison with image geometry.

    Sigmas are 1.48 times the median absolute difference of one-frame steps, at least the usual ones;
    with fewer than 20 common steps the usual ones are used.
    """
    by_pair = {(g.from_index, g.to_index): g.T_from_to for g in geometric}
    rotations, shifts = [], []
    for snippet in snippets:
        for source, T_source_target in zip(snippet.sources, snippet.T_source_target, strict=True):
            T_geometric = by_pair.get((source, snippet.target))
            length = 0.0 if T_geometric is None else float(np.linalg.norm(T_geometric[:3, 3]))
            if T_geometric is None or abs(snippet.target - source) != 1 or length == 0:
                continue
            error = invert(T_geometric) @ T_source_target
            rotations.append(Rotation.from_matrix(nearest_rotation(error[:3, :3])).as_rotvec())
            shifts.append((T_source_target[:3, 3] - T_geometric[:3, 3]) / length)
    usual = UncalibratedNoise()
    if len(rotations) < _NOISE_STEPS:
        return usual
    rotation, shift = (mad_sigma(np.concatenate(e)) for e in (rotations, shifts))
    return UncalibratedNoise(
        max(usual.rotation_sigma_deg, float(np.rad2deg(rotation))), max(usual.translation_relative_sigma, shift)
    )


def chain_raw(snippets: Sequence[SnippetPoses], count: int) -> FloatArray:
    """The raw network trajectory: target to next source of each snippet, without a graph.

    Frames before the first target and after the last come from the direct poses of these two snippets.

    Args:
        snippets: one per target, in time order without gaps.
        count: frames of the sequence.

    Returns:
        ``T_world_camera`` ``(count, 4, 4)``, unscaled, the first the identity.

    Raises:
        SlamError: if the sequence is shorter than a snippet or the snippets do not cover it.
    """
    _check_cover(snippets, count)
    first, last = snippets[0], snippets[-1]
    T_first_camera = np.tile(np.eye(4), (count, 1, 1))  # in the camera of the first target until the end
    T_first_camera[: first.target] = [first.T_target_camera[k] for k in range(first.target)] or np.zeros((0, 4, 4))
    increments = [snippet.T_target_camera[snippet.target + 1] for snippet in snippets[:-1]]
    T_first_camera[first.target : last.target + 1] = chain(np.array(increments).reshape(-1, 4, 4))
    for k in range(last.target + 1, count):
        T_first_camera[k] = T_first_camera[last.target] @ last.T_target_camera[k]
    T_world_camera: FloatArray = invert(T_first_camera[0]) @ T_first_camera
    T_world_camera[0] = np.eye(4)
    return T_world_camera


def _pair(a: int, b: int) -> tuple[int, int]:
    return min(a, b), max(a, b)


def _median_step(snippets: Sequence[SnippetPoses]) -> float:
    steps = [
        float(np.linalg.norm(T_source_target[:3, 3]))
        for snippet in snippets
        for source, T_source_target in zip(snippet.sources, snippet.T_source_target, strict=True)
        if abs(source - snippet.target) == 1
    ]
    return float(np.median(steps)) if steps else 0.0


def _check_cover(snippets: Sequence[SnippetPoses], count: int) -> None:
    if not snippets:
        raise SlamError(f"a sequence of {count} frames is shorter than one snippet of the pose network")
    targets = [snippet.target for snippet in snippets]
    first, last = snippets[0], snippets[-1]
    if targets != list(range(targets[0], targets[-1] + 1)):
        raise SlamError("the raw trajectory needs one snippet per target, in time order without gaps")
    if not set(range(first.target)) <= set(first.sources):
        raise SlamError(f"the first snippet (target {first.target}) does not reach back to frame 0")
    if not set(range(last.target + 1, count)) <= set(last.sources) or max(last.sources) >= count:
        raise SlamError(f"the last snippet (target {last.target}) does not end at frame {count - 1}")
