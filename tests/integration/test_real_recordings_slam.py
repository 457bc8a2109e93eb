"""The whole system on a real drive: every file, every number, and errors of at most twice what was measured."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from slam import run_slam


@pytest.mark.data
def test_forty_frames_of_kitti(data_root: Path, tmp_path: Path, check_run: Callable[[Path], dict[str, Any]]) -> None:
    run = run_slam(data_root / "kitti_odometry", "00", frames="0:40", output=tmp_path / "run", device="cpu")
    metrics = check_run(run.path)
    assert (metrics["sequence"]["name"], metrics["sequence"]["frames"]) == ("00", 40)
    assert metrics["scale"]["mode"] == "camera-height"
    for name, measured_m in (("network", 0.382), ("odometry", 0.216), ("optimised", 0.227)):
        assert metrics["trajectories"][name]["align"]["7dof"]["ate_rmse_m"] < 2 * measured_m
    assert metrics["map"]["accuracy_median_m"] is None and (metrics["map"]["triangles"] or 0) > 0
