"""The benchmark's plan, rows and tables without any run; then one real run, twice."""

from __future__ import annotations

import csv
import importlib
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.formats.trajectory import Trajectory
from slam.geometry.se3 import from_rotation_vector, invert
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics, ScaleMetrics

sys.path.insert(
    0, str(Path(__file__).parents[2] / "tools")
)  # as ``python tools/benchmark.py`` finds its modules
benchmark = importlib.import_module("benchmark")
columns, page, runs = (
    importlib.import_module(f"benchmarking.{name}") for name in ("metrics", "page", "runs")
)


def metrics(ate: float = 1.0, seconds: float = 20.0, **stages: float) -> Metrics:
    """The metrics of a run that the tables read."""
    alignments = {
        how: {"ate_rmse_m": ate, "scale": 1.1, "r_rel_deg_per_100m": 0.5}
        for how in ("6dof", "7dof")
    }
    tree = {
        "status": "ok",
        "provenance": {"leak": False},
        "sequence": {"frames": 100, "length_m": 90.0},
        "timing": {
            "seconds_total": seconds,
            "frames_per_second": 100 / seconds,
            "cpu_seconds": 10.0,
            "peak_rss_mb": 500.0,
            "stages": stages,
        },
        "scale": {"mode": "camera-height", "unit": "metres", "value": 1.0},
        "trajectories": {
            name: {"align": alignments} for name in ("network", "odometry", "optimised")
        },
        "graph": {"coverage": {"95": 0.9}},
        "loops": {"accepted": 3},
        "map": {"triangles": None, "triangles_reason": "no map"},
    }
    return Metrics.model_validate(tree)


@pytest.fixture
def job(tmp_path: Path) -> Any:
    drive = runs.BenchmarkSequence("loop 610", tmp_path / "world")
    return runs.Job(tmp_path / "runs", drive, "sim", runs.EVERYTHING, (), 0, "cpu")


def results_of(job: Any, ates: dict[str, Sequence[float]]) -> list[Any]:
    """Results of configurations, one per seed."""
    return [
        runs.JobResult(replace(job, configuration=name, seed=seed), metrics(ate))
        for name, values in ates.items()
        for seed, ate in enumerate(values)
    ]


def cells(table: str) -> list[list[str]]:
    """Rows of the first Markdown table, its head first."""
    lines = [line for line in table.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_accuracy_is_mean_and_deviation_over_the_seeds_that_ended_well(job: Any):
    results = results_of(job, {"default": [1.0, 3.0]})
    results.append(runs.JobResult(replace(job, seed=2), Metrics(), "out of memory"))
    text = page.error_tables(results)
    *_, head, row = cells(text)
    assert row[head.index("ATE 7-dof, optimised")] == "2.00 ± 1.41"
    assert row[head.index("scale")] == "1.100"
    assert "Failed: loop 610, sim, everything on, seed 2: out of memory" in text


@pytest.mark.parametrize(
    ("moved_m", "turned_deg", "false"), [(1.9, 4.9, 0), (2.1, 0.0, 1), (0.0, 5.1, 1)]
)
def test_true_and_false_loops(tmp_path: Path, moved_m: float, turned_deg: float, false: int):
    T_world_camera = np.tile(np.eye(4), (3, 1, 1))
    T_world_camera[:, :3, 3] = [[0, 0, 0], [4, 0, 0], [4, 0, 7]]
    T_world_camera[2, :3, :3] = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    off = from_rotation_vector(np.deg2rad([0.0, turned_deg, 0.0]), np.array([moved_m, 0.0, 0.0]))
    loops = [
        {
            "from": 1,
            "to": 2,
            "T_from_to": (invert(T_world_camera[1]) @ T_world_camera[2] @ off).tolist(),
        }
    ]
    RunFolder(tmp_path).write_metrics(metrics())
    (tmp_path / "loops.json").write_text(json.dumps({"accepted": loops}))
    RunFolder(tmp_path).write_trajectory("reference", Trajectory(np.arange(3.0), T_world_camera))
    assert runs.loops(tmp_path) == (1 - false, false)
    runs.loops.cache_clear()
    in_heights = metrics().changed(
        scale=ScaleMetrics(mode="none", unit="camera heights", value=1.0)
    )
    RunFolder(tmp_path).write_metrics(in_heights)
    assert runs.loops(tmp_path) == (None, None)


@pytest.mark.slow
def test_two_checkouts_in_turn(tmp_path: Path):
    report, here = tmp_path / "page.md", Path(__file__).parents[2]
    words = f"speed --against {here} --frames 12 --pairs 1 --output {tmp_path / 'out'}"
    benchmark.main([*words.split(), "--report", str(report)])
    text = report.read_text()
    table = cells(text)
    head, row = table[0], table[1]
    before, after = (
        float(part.split(":")[0]) for part in row[head.index("CPU ms / frame")].split(",")
    )
    assert row[0] == "grid 610, 12 frames" and before > 0 and after > 0
    assert "geometry" in table[2] and str(tmp_path) not in text


@pytest.mark.slow
def test_one_real_run_and_one_that_fails(tmp_path: Path):
    report = tmp_path / "page.md"
    words = "accuracy --routes straight --worlds 610 --frames 8 --seeds 0 --weights sim nonesuch"
    words += f" --set mapping.enabled=false --output {tmp_path / 'out'} --report {report}"
    benchmark.main(words.split())
    with (tmp_path / "out" / "accuracy.csv").open() as file:
        real, failed = csv.DictReader(file)
    assert (real["status"], real["frames"], failed["status"]) == ("ok", "8", "failed")
    assert 0 < float(real["ATE 7-dof, optimised"]) < 1
    assert "nonesuch" in failed["reason"]
    *_, head, real_row, failed_row = cells(report.read_text())
    assert [row[head.index("frames")] for row in (real_row, failed_row)] == ["8", "–"]
    assert str(tmp_path) not in report.read_text()
    assert "](images/trajectories.png)" in report.read_text()
    assert cv2.imread(str(tmp_path / "images" / "trajectories.png")).std() > 0

    (written,) = (tmp_path / "out" / "accuracy").glob("*/*sim*/metrics.json")
    before = written.stat().st_mtime_ns
    benchmark.main(words.split())
    assert written.stat().st_mtime_ns == before
