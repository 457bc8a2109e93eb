"""Metrics derived from those of a run: errors relative to the path and to the network, true and false loops."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.geometry.se3 import FloatArray, invert, rotation_angle
from slam.results.folder import RunFolder
from slam.results.metrics import LoopsFile, Metrics
from slam.runtime.run_files import LOOPS
from slam.runtime.storage.record import Missing

FALSE_M, FALSE_DEG = 2.0, 5.0  # a loop with a larger error is false


@dataclass(frozen=True)
class DerivedMetrics:
    """Relative errors, and the number of true and of false accepted loops.

    ``*_percent`` are 7-dof ATE in per cent of the true path, ``of_network`` the optimised over the network's,
    ``fusion_ms`` the time of fusion for a fused keyframe, without the refinement of its depth.
    """

    network_percent: float | Missing
    optimised_percent: float | Missing
    of_network: float | Missing
    fusion_ms: float | Missing
    true_loops: int | Missing
    false_loops: int | Missing


def derive_metrics(folder: Path, metrics: Metrics) -> DerivedMetrics:
    """What follows from the metrics of a run and its files."""
    length, trajectories, stages = metrics.sequence.length_m, metrics.trajectories, metrics.timing.stages
    network, optimised = trajectories.network.align.dof7.ate_rmse_m, trajectories.optimised.align.dof7.ate_rmse_m
    fusion = stages if isinstance(stages, Missing) else stages.get("map", Missing("no map"))
    return DerivedMetrics(
        _ratio(network, length, 100.0),
        _ratio(optimised, length, 100.0),
        _ratio(optimised, network, 1.0),
        _ratio(fusion, metrics.map.frames_fused, 1e3),
        *_loops(folder, metrics),
    )


def _ratio(part: float | Missing, whole: float | Missing, unit: float) -> float | Missing:
    if isinstance(part, Missing):
        return part
    if isinstance(whole, Missing):
        return whole
    return unit * part / whole if whole else Missing("nothing to compare with")


def _loops(folder: Path, metrics: Metrics) -> tuple[int | Missing, int | Missing]:
    """Number of true and of false loops."""
    reference, number = RunFolder.open(folder).trajectory("reference"), metrics.loops.accepted
    if reference is None:
        number = Missing("the sequence has no true poses")
    elif not metrics.is_metric:
        number = Missing(f"loops in {metrics.unit} cannot be compared with metres")
    if reference is None or isinstance(number, Missing):
        return number, number
    accepted = list(LoopsFile.read(folder / LOOPS).accepted)
    false = sum(
        is_false(np.array(loop.T_from_to), *reference.T_world_camera[[loop.from_, loop.to]]) for loop in accepted
    )
    return len(accepted) - false, false


def is_false(T_from_to: FloatArray, T_world_from: FloatArray, T_world_to: FloatArray) -> bool:
    """Whether a measured relative pose, metres, is too far off the true one."""
    off = invert(invert(T_world_from) @ T_world_to) @ T_from_to
    far = np.linalg.norm(off[:3, 3]) > FALSE_M
    return bool(far or rotation_angle(off[:3, :3]) > np.deg2rad(FALSE_DEG))
