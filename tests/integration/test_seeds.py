"""``run --seed``: one seed gives the same bytes again, another gives other RANSAC draws and a trajectory close by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam import run_slam
from slam.results.folder import RunFolder

QUICK = ("mapping.enabled=false", "output.report=false")
BYTES = ("trajectory_odometry.kitti.txt", "trajectory_optimised.kitti.txt", "graph.g2o")
ATE_M = 0.052  # measured; each run may have twice that


@pytest.mark.slow
def test_seeds_on_the_simulated_street(tmp_path: Path) -> None:
    def run(name: str, seed: int) -> RunFolder:
        options = {"frames": "20:45", "weights": "sim", "overrides": QUICK, "device": "cpu"}
        return run_slam(output=tmp_path / name, seed=seed, **options)

    first, again, other = run("first", 1), run("again", 1), run("other", 2)
    for name in BYTES:
        assert (first.path / name).read_bytes() == (again.path / name).read_bytes()
    one, two = (each.trajectory("optimised").positions for each in (first, other))
    assert 0 < np.linalg.norm(one - two, axis=1).max() < 2 * ATE_M
    for each in (first, other):
        assert (
            each.metrics().tree()["trajectories"]["optimised"]["align"]["7dof"]["ate_rmse_m"]
            < 2 * ATE_M
        )
