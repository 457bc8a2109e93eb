"""Fixtures of the system's tests: a run folder of a drive around a block, as ``erfsfm-slam run`` writes it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from slam.formats.ply import Ply, write_ply
from slam.formats.trajectory import Trajectory
from slam.geometry.se3 import FloatArray, chain, from_rotation_vector
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics

MakeRun = Callable[..., RunFolder]

GEOMETRY = {"network": (0.9, 0.0035), "odometry": (1.02, 0.0012), "optimised": (1.01, 0.0003)}
G2O = (
    "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 0 0 1 0 0 0 1\n"
    "EDGE_SE3:QUAT 0 1 0 0 1 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n"
)
CORNERS = np.array([(0, 0, 1), (1, 0, 1), (0, -2, 1)], [(axis, "<f4") for axis in "xyz"])


PROVENANCE = yaml.safe_load("""
version: 0.1.0
commit: 3a18a19
command: erfsfm-slam run --sequence '<b>09</b>' & more
seed: 0
device: cpu
weights: default
weights_licence: "MIT: trained on our own simulated streets"
depth_source: network
""")
PROVENANCE |= {"weights_sha256": "9f" * 32, "depth_sha256": "9f" * 32}
PROVENANCE |= {"trained_on": [f"sim/seed{k}" for k in range(20)]}
TIMING = yaml.safe_load("""
seconds_total: 61.3
frames_per_second: 4.9
cpu_seconds: 118.2
peak_rss_mb: 1432.1
stages: {read: 3.1, depth network: 24.0, pose network: 11.2, geometry: 9.8, map: 11.9}
""")


def drive(frames: int, step_m: float, yaw_bias: float) -> FloatArray:
    """Poses ``(N, 4, 4)``: once around a block, with a constant error of rotation a step."""
    phase = np.linspace(0.0, 2.0 * np.pi, frames - 1)
    yaw = 2.0 * np.pi / frames * (1.0 + 0.9 * np.cos(4.0 * phase)) + yaw_bias
    rotation_vector = np.stack([np.zeros_like(yaw), yaw, np.zeros_like(yaw)], axis=1)
    step = np.tile([0.0, 0.0, step_m], (frames - 1, 1))
    return chain(from_rotation_vector(rotation_vector, step))


def alignment(ate: float, scale: float) -> dict[str, Any]:
    return {
        "ate_rmse_m": ate,
        "t_rel_percent": 1.4 * ate,
        "r_rel_deg_per_100m": 0.4 * ate,
        "rpe_trans_m": 0.0213,
        "rpe_rot_deg": 0.0571,
        "scale": scale,
    }


def errors_of(ate: float) -> dict[str, Any]:
    return {
        "snippet5": {
            "ate_mean": 0.0123,
            "ate_std": 0.006,
            "re_mean": 0.0021,
            "re_std": 0.001,
            "count": 296,
        },
        "align": {
            "none": alignment(9.0 * ate, 1.0),
            "first": alignment(9.0 * ate, 1.0),
            "scale": alignment(2.5 * ate, 1.1),
            "6dof": alignment(3.0 * ate, 1.0),
            "7dof": alignment(ate, 1.12),
        },
        "evo": {
            "ape_rmse_m_7dof": ate,
            "rpe_trans_m": 0.0213,
            "rpe_rot_deg": 0.0571,
            "difference": 3.1e-12,
        },
    }


def map_errors(median_m: float) -> dict[str, Any]:
    """Errors of a map whose completeness is not known."""
    at = {"0.2": 0.61, "0.5": 0.76}
    sizes = {"accuracy_median_m": median_m, "accuracy_90_m": 9 * median_m, "outlier_share": 0.04}
    missing = {"completeness": None, "completeness_reason": "the true surface is not known"}
    return {**sizes, **missing, "f_score": at, "precision": at, "recall": at}


def metrics_of(
    leak: bool = False, mode: str = "camera-height", reference: bool = True
) -> dict[str, Any]:
    """``metrics.json`` as in section 7 of the design."""
    truth, unit = "the sequence has no true poses", "camera heights" if mode == "none" else "metres"
    unknown = {"snippet5": None, "snippet5_reason": truth, "align": None, "align_reason": truth}
    unknown |= {"evo": None, "evo_reason": truth}
    numbers = {"network": 6.21, "odometry": 2.43, "optimised": 0.87}
    trajectories: dict[str, Any] = {
        k: errors_of(v) if reference else unknown for k, v in numbers.items()
    }
    if reference:
        for alignment in trajectories["odometry"]["align"].values():
            alignment |= {
                "t_rel_percent": None,
                "t_rel_percent_reason": "no segment of 100 m was left",
            }
    trajectories |= {"lidar": None, "lidar_reason": "the sequence has no LiDAR scans"}
    return {
        "schema": 1,
        "status": "ok",
        "provenance": PROVENANCE | {"leak": leak},
        "sequence": {"frames": 300, "fps": 10.0}
        | (
            {"name": "sim/loop <42>", "length_m": 299.0}
            if reference
            else {"name": "video", "length_m": None, "length_m_reason": truth}
        ),
        "timing": TIMING,
        "scale": {"mode": mode, "unit": unit, "value": 1.0 if mode == "none" else 1.6503},
        "trajectories": trajectories,
        "graph": {"nodes": 300, "factors": 1483, "coverage": {"50": 0.47, "90": 0.88, "95": 0.93}}
        if reference
        else {"nodes": 300, "factors": 1483, "coverage": None, "coverage_reason": truth},
        "loops": {
            "candidates": 12,
            "verified": 3,
            "accepted": 1,
            "rejected": [{"from": 290, "to": 3, "reason": "parallax <b>too small</b>"}],
        },
        "map": {
            "triangles": 48213,
            "points": 26102,
            "blocks": 912,
            **map_errors(0.081),
            "in_field": {"share": 0.853, **map_errors(0.071)},
            "truth": "lidar",
            "evaluated_m": 59.9,
            "with_scale": {"scale": 1.006, **map_errors(0.079)},
            "by_distance": [
                {"from_m": 5.0 * k, "to_m": 5.0 * k + 5.0, **map_errors(0.05 * (k + 1))}
                for k in range(5)
            ],
        },
    }


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    """Builds a run folder; ``metrics`` replaces the numbers, ``reference`` writes the truth."""

    def make(
        name: str = "run", metrics: dict[str, Any] | None = None, reference: bool = True
    ) -> RunFolder:
        folder = RunFolder.create(tmp_path / name, tmp_path, "sim")
        stamps = 0.1 * np.arange(300)
        for each, (step_m, yaw_bias) in GEOMETRY.items():
            folder.write_trajectory(each, Trajectory(stamps, drive(300, step_m, yaw_bias)))
        if reference:
            folder.write_trajectory("reference", Trajectory(stamps, drive(300, 1.0, 0.0)))
        folder.write("graph.g2o", G2O)
        write_ply(folder.path / "map_mesh.ply", Ply(CORNERS, np.array([[0, 1, 2]])))
        write_ply(folder.path / "map_cloud.ply", Ply(CORNERS))
        folder.write("config.yaml", "scale:\n  mode: auto\n")
        folder.write("loops.json", '{"accepted": [{"from": 295, "to": 2}], "rejected": []}\n')
        folder.write_metrics(
            Metrics.model_validate(
                metrics if metrics is not None else metrics_of(reference=reference)
            )
        )
        return folder

    return make


@pytest.fixture
def make_metrics() -> Callable[..., dict[str, Any]]:
    """``metrics_of``: a realistic ``metrics.json``."""
    return metrics_of
