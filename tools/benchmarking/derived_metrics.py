"""Metrics derived from those of a run: errors relative to the path and to the network, true and false loops."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from slam.geometry.se3 import FloatArray, invert, rotation_angle
from slam.results.comparison import is_metric, lookup, unit_of_lengths
from slam.results.folder import RunFolder
from slam.results.summary import null
from slam.runtime.run_files import LOOPS

FALSE_M, FALSE_DEG = 2.0, 5.0  # a loop with a larger error is false


def derive_metrics(folder: Path, metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Relative errors, and the number of true and of false accepted loops.

    ``*_percent`` are 7-dof ATE in per cent of the true path, ``of_network`` the optimised over the network's,
    ``fusion_ms`` the time of fusion for a fused keyframe, without the refinement of its depth.
    """
    length = lookup(metrics, "sequence", "length_m")
    network, optimised = (_ate(metrics, name) for name in ("network", "optimised"))
    return {
        **_ratio("network_percent", network, length, 100.0),
        **_ratio("optimised_percent", optimised, length, 100.0),
        **_ratio("of_network", optimised, network, 1.0),
        **_fusion(metrics),
        **_loops(folder, metrics),
    }


def _ate(metrics: Mapping[str, Any], trajectory: str) -> tuple[float | None, str]:
    return lookup(metrics, "trajectories", trajectory, "align", "7dof", "ate_rmse_m")


def _ratio(name: str, part: tuple[float | None, str], whole: tuple[float | None, str], unit: float) -> dict[str, Any]:
    if part[0] is None or not whole[0]:
        return null(name, part[1] or whole[1] or "nothing to compare with")
    return {name: unit * part[0] / whole[0]}


def _fusion(metrics: Mapping[str, Any]) -> dict[str, Any]:
    seconds, reason = lookup(metrics, "timing", "stages", "map")
    return _ratio("fusion_ms", (seconds, reason or "no map"), lookup(metrics, "map", "frames_fused"), 1e3)


def _loops(folder: Path, metrics: Mapping[str, Any]) -> dict[str, Any]:
    reference = RunFolder.open(folder).trajectory("reference")
    reason = lookup(metrics, "loops", "accepted")[1]
    if reference is None:
        reason = "the sequence has no true poses"
    elif not is_metric(metrics):
        reason = f"loops in {unit_of_lengths(metrics)} cannot be compared with metres"
    if reference is None or reason:
        return null("true_loops", reason) | null("false_loops", reason)
    accepted = json.loads((folder / LOOPS).read_text(encoding="utf-8"))["accepted"]
    false = sum(
        is_false(np.array(loop["T_from_to"]), *reference.T_world_camera[[loop["from"], loop["to"]]])
        for loop in accepted
    )
    return {"true_loops": len(accepted) - false, "false_loops": false}


def is_false(T_from_to: FloatArray, T_world_from: FloatArray, T_world_to: FloatArray) -> bool:
    """Whether a measured relative pose, metres, is too far off the true one."""
    off = invert(invert(T_world_from) @ T_world_to) @ T_from_to
    far = np.linalg.norm(off[:3, 3]) > FALSE_M
    return bool(far or rotation_angle(off[:3, :3]) > np.deg2rad(FALSE_DEG))
