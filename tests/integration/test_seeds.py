"""``run --seed``: one seed gives the same bytes again, another gives other RANSAC draws and a trajectory close by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam import run_slam
from slam.results.folder import RunFolder

QUICK = ("mapping.enabled=false", "output.report=false")
BYTES = ("trajectory_odometry.kitti.txt", "trajectory_optimised.kitti.txt", "graph.g2o")


def check_seeds(folder: Path, dataset: Path | None, sequence: str | None, frames: str, ate_m: float) -> None:
    """Seed 1 twice and seed 2 once; ``ate_m`` is what was measured, and each run may have twice that."""

    def run(name: str, seed: int) -> RunFolder:
        options = {"frames": frames, "weights": "sim", "overrides": QUICK, "device": "cpu"}
        return run_slam(dataset, sequence, output=folder / name, seed=seed, **options)

    first, again, other = run("first", 1), run("again", 1), run("other", 2)
    for name in BYTES:
        assert (first.path / name).read_bytes() == (again.path / name).read_bytes()
    trajectories = [each.trajectory("optimised") for each in (first, other)]
    positions = [each.positions for each in trajectories if each is not None]
    apart_m = np.linalg.norm(positions[0] - positions[1], axis=1).max()
    assert 0 < apart_m < 2 * ate_m
    for each in (first, other):
        assert each.metrics().tree()["trajectories"]["optimised"]["align"]["7dof"]["ate_rmse_m"] < 2 * ate_m


@pytest.mark.slow
def test_seeds_on_the_simulated_street(tmp_path: Path) -> None:
    check_seeds(tmp_path, None, None, "20:45", 0.034)


@pytest.mark.data
@pytest.mark.slow
def test_seeds_on_kitti(tmp_path: Path, data_root: Path) -> None:
    check_seeds(tmp_path, data_root / "kitti_odometry", "00", "0:30", 0.189)
