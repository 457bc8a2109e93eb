"""KITTI's drift: relative errors over segments of a given path length (Geiger et al. 2012), and the alignment of a
run's trajectories for figures.

``slam/evaluation/trajectory.py`` computes the numbers of ``metrics.json`` from the same segments.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.formats.trajectory import Trajectory, associate
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.runtime.files import REFERENCE

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
FIGURE_LENGTHS_M = (10.0, 20.0, 50.0, *KITTI_LENGTHS_M)
SEGMENT_STEP = 10

IndexArray = NDArray[np.intp]


@dataclass(frozen=True)
class SegmentErrors:
    """Errors of all segments of one path length, both ``(S,)``: ``translation_m``, ``rotation`` in radians."""

    length_m: float
    translation_m: FloatArray
    rotation: FloatArray


def aligned(trajectories: Mapping[str, Trajectory]) -> dict[str, Trajectory]:
    """Estimates brought to the reference by the best similarity of positions (Umeyama 1991).

    Without a reference they stay as written, only the raw network is brought to the optimised one's scale.
    """
    drawn = dict(trajectories)
    if REFERENCE in drawn:
        for name in trajectories.keys() - {REFERENCE}:
            estimate, truth = associate(drawn[name], drawn[REFERENCE])
            fit = se3.umeyama(truth.positions, estimate.positions, with_scale=True)
            drawn[name] = replace(drawn[name], T_world_camera=fit.apply_to_poses(drawn[name].T_world_camera))
    elif "network" in drawn and "optimised" in drawn:
        raw, optimised = associate(drawn["network"], drawn["optimised"])
        energy = float((raw.positions**2).sum())
        scale = float((raw.positions * optimised.positions).sum()) / energy if energy > 0 else 1.0
        fit = se3.Similarity(scale, np.eye(3), np.zeros(3))
        drawn["network"] = replace(drawn["network"], T_world_camera=fit.apply_to_poses(drawn["network"].T_world_camera))
    return drawn


def paired(trajectories: Mapping[str, Trajectory]) -> Iterator[tuple[str, Trajectory, Trajectory]]:
    """Name, aligned estimate and truth, row by row, of every estimate; a reference is among the trajectories."""
    for name, trajectory in aligned(trajectories).items():
        if name != REFERENCE:
            yield name, *associate(trajectory, trajectories[REFERENCE])


def segment_errors(
    T_world_estimate: FloatArray, T_world_reference: FloatArray, lengths_m: Iterable[float]
) -> list[SegmentErrors]:
    """Relative errors of all segments of each length within the true path, starting every ten frames.

    A segment ends at the first frame beyond its length. Lengths without a segment are left out.

    Args:
        T_world_estimate: poses ``(N, 4, 4)``, row k beside row k of the reference, in metres.
        T_world_reference: true poses ``(N, 4, 4)``.
        lengths_m: path lengths, in increasing order.
    """
    distance = se3.path_distance(T_world_reference)
    segments = []
    for length_m in lengths_m:
        starts = np.arange(0, len(distance), SEGMENT_STEP)
        ends = np.searchsorted(distance, distance[starts] + length_m, side="right")
        fits = ends < len(distance)
        if not fits.any():
            break
        errors = relative_errors(T_world_estimate, T_world_reference, starts[fits], ends[fits])
        segments.append(SegmentErrors(length_m, *errors))
    return segments


def relative_errors(
    T_world_estimate: FloatArray, T_world_reference: FloatArray, starts: IndexArray, ends: IndexArray
) -> tuple[FloatArray, FloatArray]:
    """Translation (metres) and rotation (radians) errors ``(M,)`` of the motions between pairs of rows.

    E = (T_est,i^-1 T_est,j)^-1 (T_ref,i^-1 T_ref,j)      (Geiger et al. 2012, Eqs. 2-3)
    """
    T_start_end_estimate = se3.invert(T_world_estimate[starts]) @ T_world_estimate[ends]
    T_start_end_reference = se3.invert(T_world_reference[starts]) @ T_world_reference[ends]
    T_error = se3.invert(T_start_end_estimate) @ T_start_end_reference
    return np.linalg.norm(T_error[:, :3, 3], axis=1), se3.rotation_angle(T_error[:, :3, :3])
