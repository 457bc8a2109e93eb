"""How far the trajectories of a run stand from the truth once they are laid over it, for figures.

The numbers of ``metrics.json`` come from ``slam/evaluation/trajectory.py``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from slam import se3
from slam.se3 import FloatArray
from slam.trajectory import Trajectory, associate

REFERENCE = "reference"
SEGMENT_LENGTHS_M = (10.0, 20.0, 50.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
SEGMENT_STEP = 10


@dataclass(frozen=True)
class Drift:
    """Mean error of segments of one length: ``translation`` as a share, ``rotation`` in radians a metre."""

    length_m: float
    translation: float
    rotation: float


def aligned(trajectories: Mapping[str, Trajectory]) -> dict[str, Trajectory]:
    """Estimates brought to the reference by the best similarity of positions (Umeyama 1991).

    Without a reference they stay as written, only the raw network is brought to the optimised one's scale.
    """
    drawn = dict(trajectories)
    if REFERENCE in drawn:
        for name, trajectory in estimates(drawn):
            estimate, truth = associate(trajectory, drawn[REFERENCE])
            fit = se3.umeyama(truth.positions, estimate.positions, with_scale=True)
            moved = fit.apply_to_poses(trajectory.T_world_camera)
            drawn[name] = Trajectory(trajectory.stamps, moved, trajectory.timed)
    elif "network" in drawn and "optimised" in drawn:
        raw, optimised = associate(drawn["network"], drawn["optimised"])
        energy = float((raw.positions**2).sum())
        scale = float((raw.positions * optimised.positions).sum()) / energy if energy > 0 else 1.0
        fit = se3.Similarity(scale, np.eye(3), np.zeros(3))
        moved = fit.apply_to_poses(drawn["network"].T_world_camera)
        drawn["network"] = Trajectory(drawn["network"].stamps, moved, drawn["network"].timed)
    return drawn


def segment_drifts(estimate: Trajectory, reference: Trajectory) -> list[Drift]:
    """Mean relative error of all segments of each length that the path holds, one start every tenth frame.

    E = (T_est,i^-1 T_est,j)^-1 (T_ref,i^-1 T_ref,j)      (Geiger et al. 2012, Eqs. 2-3)

    Args:
        estimate: metric poses, row k beside row k of the reference.
        reference: true poses.
    """
    distance = travelled(reference)
    drifts = []
    for length_m in SEGMENT_LENGTHS_M:
        starts = np.arange(0, len(reference), SEGMENT_STEP)
        ends = np.searchsorted(distance, distance[starts] + length_m, side="right")
        starts, ends = starts[ends < len(reference)], ends[ends < len(reference)]
        if not len(starts):
            break
        T_start_end = [se3.invert(t.T_world_camera[starts]) @ t.T_world_camera[ends] for t in (estimate, reference)]
        T_error = se3.invert(T_start_end[0]) @ T_start_end[1]
        translation = float(np.linalg.norm(T_error[:, :3, 3], axis=1).mean()) / length_m
        drifts.append(Drift(length_m, translation, float(se3.rotation_angle(T_error[:, :3, :3]).mean()) / length_m))
    return drifts


def estimates(trajectories: Mapping[str, Trajectory]) -> list[tuple[str, Trajectory]]:
    """All but the reference, by name."""
    return [(name, trajectory) for name, trajectory in trajectories.items() if name != REFERENCE]


def travelled(trajectory: Trajectory) -> FloatArray:
    """Distance travelled ``(N,)`` up to each pose."""
    steps = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])
