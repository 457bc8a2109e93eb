"""The benchmark's drives: each error of the optimised trajectory may be twice what was measured.

The figures are of ``erfsfm-slam run`` on all frames of each sequence (300 of KITTI, 320 of the embedded loop). The map
and the report are left out here: trajectories do not depend on them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from slam import run_slam
from slam.results.folder import RunFolder

SLACK = 2.0
QUICK = ("mapping.enabled=false", "output.report=false")


@dataclass(frozen=True)
class Measured:
    """Errors of one drive as measured: ATE in metres after 7 and 6 dof alignment, rotation drift."""

    sequence: str
    weights: str
    ate_7dof_m: float
    ate_6dof_m: float
    r_rel_deg_per_100m: float

    def __str__(self) -> str:
        return f"{self.sequence}-{self.weights}"


KITTI = (
    Measured("00", "sim", 0.225, 0.225, 0.929),
    Measured("02", "default", 0.346, 0.418, 0.397),
    Measured("00", "default", 0.174, 0.227, 0.955),
    Measured("02", "sim", 0.335, 0.343, 0.368),
    Measured("05", "sim", 0.190, 0.302, 0.507),
    Measured("05", "default", 0.297, 0.349, 0.513),
)
LOOP = (
    Measured("loop", "sim", 0.228, 0.257, 0.159),
    Measured("loop", "default", 0.220, 0.260, 0.125),
)
LOOPS_CLOSED = 23  # among views of every fourth frame


def check(run: RunFolder, measured: Measured) -> None:
    metrics = run.metrics().tree()
    align = metrics["trajectories"]["optimised"]["align"]
    assert metrics["scale"]["mode"] == "camera-height"
    assert align["7dof"]["ate_rmse_m"] < SLACK * measured.ate_7dof_m
    assert align["6dof"]["ate_rmse_m"] < SLACK * measured.ate_6dof_m
    assert align["7dof"]["r_rel_deg_per_100m"] < SLACK * measured.r_rel_deg_per_100m


@pytest.mark.data
@pytest.mark.slow
def test_two_seconds_are_as_right_after_the_graph_as_before(data_root: Path, tmp_path: Path):
    options = {"weights": "sim", "frames": "0:20", "overrides": QUICK, "output": tmp_path / "run"}
    found = run_slam(data_root / "kitti_odometry", "02", **options).metrics().tree()["trajectories"]
    before, after = (
        found[kind]["align"]["none"]["ate_rmse_m"] for kind in ("odometry", "optimised")
    )
    assert after < 1.2 * before < 0.3


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("measured", KITTI, ids=str)
def test_kitti(data_root: Path, tmp_path: Path, measured: Measured):
    root = data_root / "kitti_odometry"
    run = run_slam(
        root, measured.sequence, weights=measured.weights, overrides=QUICK, output=tmp_path / "run"
    )
    check(run, measured)


@pytest.mark.slow
@pytest.mark.parametrize("measured", LOOP, ids=str)
def test_the_embedded_loop(tmp_path: Path, measured: Measured):
    run = run_slam(weights=measured.weights, overrides=QUICK, output=tmp_path / "run")
    check(run, measured)
    assert run.metrics().tree()["loops"]["accepted"] > LOOPS_CLOSED / SLACK
