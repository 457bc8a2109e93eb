"""Steps of the pose network, with the unit and the noise that image geometry measures of them.

The network's lengths have a unit of their own, which is not that of learned depth and changes with
the street. Both it and the noise are measured against the steps of image geometry
(``docs/design/learned-priors.md``).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from slam.frames import RelativePose, SnippetPoses
from slam.geometry.robust import MAD_TO_SIGMA, median, running_median
from slam.geometry.se3 import FloatArray, chain, in_unit, invert, rigid, tangent

NETWORK_SOURCE = "network"
STUDENT_T_DOF = 12.0  # of the errors of measured steps: degrees of freedom of Student's t
# steps that image geometry measured too, from which on unit and noise are measured
LEAST_PAIRS = 20
_USUAL_STEPS = 41  # whose median length is the usual one around a step
_LONGEST_PAIR = 4  # frames: as far as a snippet reaches
_SHORTEST_PAIR = 0.1  # over the median length of a step: shorter ones say nothing about the unit
_CORRELATED_STEPS = 50  # over which errors are taken as equal
# of a step whose noise is not measured: radians, and over its length in the unit of learned depth,
# from which that of the network differs by so much from drive to drive
_USUAL_SIGMAS = np.repeat([np.deg2rad(0.3), 0.3], 3)
_LEAST_SIGMAS = np.repeat([np.deg2rad(0.03), 0.02], 3)


@dataclass(frozen=True)
class NetworkCalibration:
    """Unit and noise of the pose network's steps, measured on the drive.

    Attributes:
        unit: ``(N,)``, length per unscaled length of the step from each frame: one of the drive, or
            that of learned depth where it is not measured.
        sigmas: ``(6,)`` of a step, rotation in radians, then translation over the usual length of a
            step.
        pairs: steps that image geometry measured too; with fewer than 20 of them the unit is that
            of learned depth.
    """

    unit: FloatArray
    sigmas: FloatArray
    pairs: int

    @property
    def is_measured(self) -> bool:
        """Whether enough steps measured the unit and the noise."""
        return self.pairs >= LEAST_PAIRS

    def over(self, depth_unit: FloatArray) -> str:
        """The unit over that of learned depth ``(N,)`` and the noise, for logs."""
        if not self.is_measured:
            return (
                f"fewer than {LEAST_PAIRS} steps measure its unit, that of learned depth is taken"
            )
        rotation = np.rad2deg(np.median(self.sigmas[:3]))
        return (
            f"by {self.pairs} steps its unit is {np.median(self.unit / depth_unit):.2f} of that of learned depth, and "
            f"its noise {rotation:.2f} degrees and {100 * self.sigmas[5]:.0f} % of a step"
        )

    def scaled(self, steps: Mapping[int, FloatArray]) -> dict[int, FloatArray]:
        """Steps ``T_k_next`` by k in the unit."""
        return {k: in_unit(T_k_next, self.unit[k]) for k, T_k_next in steps.items()}


def network_steps(snippets: Iterable[SnippetPoses]) -> dict[int, FloatArray]:
    """``T_k_next`` by k, unscaled: the mean of the snippets that see both frames."""
    seen: dict[int, list[FloatArray]] = {}
    for snippet in snippets:
        for k, T_k_next in _steps(snippet).items():
            seen.setdefault(k, []).append(T_k_next)
    means = rigid(np.array([np.mean(each, axis=0) for each in seen.values()]).reshape(-1, 4, 4))
    return dict(sorted(zip(seen, means, strict=True), key=lambda step: step[0]))


def calibrate_network(
    steps: Mapping[int, FloatArray], geometric: Sequence[RelativePose], depth_unit: FloatArray
) -> NetworkCalibration:
    """The unit and the noise of the network's steps, by the poses that image geometry measured too.

    They are medians over all of these. With fewer than 20 of them, lengths are in the unit of
    learned depth, and accordingly uncertain.

    Args:
        steps: ``T_k_next`` by k, unscaled.
        geometric: poses by image geometry, also across several frames.
        depth_unit: unit of these poses per unit of learned depth at each frame ``(N,)``.
    """
    pairs, by_network = [], []
    for pose in geometric:
        between = range(*pose.ends)
        if 0 < len(between) <= _LONGEST_PAIR and steps.keys() >= set(between):
            pairs.append(pose)
            by_network.append(reduce(np.matmul, (steps[k] for k in between)))
    by_depth = NetworkCalibration(depth_unit, _USUAL_SIGMAS, 0)
    if len(pairs) < LEAST_PAIRS:
        return by_depth
    first, last = np.array([pose.ends for pose in pairs]).T
    T_network = np.array(by_network)
    T_geometric = np.array([pose.T_from_to for pose in pairs])
    t_network, t_geometric = T_network[:, :3, 3], T_geometric[:, :3, 3]
    length = np.linalg.norm(t_geometric, axis=1)
    frames = last - first
    # along the measured motion, where the network's noise has no bias, as it has in the length
    ratio = (t_network * t_geometric).sum(axis=1) / np.maximum(length, 1e-12) ** 2
    used = (ratio > 0) & (length > _SHORTEST_PAIR * np.median(length / frames) * frames)
    if used.sum() < LEAST_PAIRS:
        return by_depth
    unit = 1.0 / median(ratio[used])
    t_network *= unit
    reach = np.where(np.arange(6) < 3, frames[:, None], length[:, None])
    error = np.abs(tangent(invert(T_network[used]) @ T_geometric[used])) / reach[used]
    # the unit follows image geometry, and so shares its errors
    shared = np.array([pose.sigmas for pose in pairs])[used] / reach[used]
    sigmas = np.hypot(MAD_TO_SIGMA * np.median(error, axis=0), np.median(shared, axis=0))
    sigmas = np.maximum(sigmas, _LEAST_SIGMAS)
    return NetworkCalibration(np.full_like(depth_unit, unit), sigmas, int(used.sum()))


def network_factors(
    steps: Mapping[int, FloatArray], calibration: NetworkCalibration
) -> list[RelativePose]:
    """A factor for every step ``T_k_next`` of the network, in the unit of the calibration."""
    if not steps:
        return []
    scaled = calibration.scaled(steps)
    lengths = np.array([np.linalg.norm(T_k_next[:3, 3]) for T_k_next in scaled.values()])
    # sigmas by its own length would give a step that came out short more weight, and a drive that
    # is too short
    usual = running_median(lengths, _USUAL_STEPS)
    reach = np.maximum(usual, _SHORTEST_PAIR * np.median(lengths)).clip(1e-9)
    # with nothing beside them, the usual sigmas are wide enough by themselves
    widening = np.sqrt(_CORRELATED_STEPS) if calibration.is_measured else 1.0
    factors = []
    for (k, T_k_next), length in zip(scaled.items(), reach, strict=True):
        sigmas = calibration.sigmas * np.repeat([1.0, length], 3)
        factors.append(
            RelativePose(
                k, k + 1, T_k_next, sigmas, NETWORK_SOURCE, widening * sigmas, STUDENT_T_DOF
            )
        )
    return factors


def chain_raw(snippets: Sequence[SnippetPoses], count: int) -> FloatArray:
    """The network trajectory: target to next source of each snippet, without a graph.

    Frames before the first target and after the last come from the direct poses of these two
    snippets. There is one a target, in time order without gaps.

    Returns:
        ``T_world_camera`` ``(count, 4, 4)``, unscaled, the first the identity.
    """
    steps: dict[int, FloatArray] = {}
    for snippet in snippets:
        for k, T_k_next in _steps(snippet).items():
            if k == snippet.target or k not in steps:
                steps[k] = T_k_next
    return chain(np.array([steps[k] for k in range(count - 1)]))


def _steps(snippet: SnippetPoses) -> dict[int, FloatArray]:
    T_target = snippet.T_target_camera
    return {
        k: invert(T_target[k]) @ T_target[k + 1]
        for k in range(min(snippet.sources), max(snippet.sources))
    }
