"""The table of a run's errors: all numbers, and the reasons of missing ones."""

import io
from typing import Any

import numpy as np
from rich.console import Console

from slam.evaluation.trajectory import trajectory_metrics
from slam.formats.trajectory import Trajectory
from slam.results.terminal_table import metrics_table


def metrics(frames: int, reference: bool = True) -> dict[str, Any]:
    """T of a wobbly drive along z."""
    T_world_camera = np.tile(np.eye(4), (frames, 1, 1))
    T_world_camera[:, 2, 3] = np.arange(frames)
    T_world_camera[:, 0, 3] = 5 * np.sin(0.1 * np.arange(frames))
    truth = T_world_camera.copy()
    truth[:, 1, 3] = 0.25 * (-1.0) ** np.arange(frames)
    stamps = np.arange(frames, dtype=np.float64)
    return trajectory_metrics(Trajectory(stamps, T_world_camera), Trajectory(stamps, truth) if reference else None)


def shown(trajectories: dict[str, Any], title: str) -> str:
    console = Console(width=200, file=io.StringIO(), color_system=None)
    console.print(metrics_table(trajectories, title))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_rows_columns_and_title() -> None:
    T = metrics(250)
    text = shown({"network": T, "optimised": T}, "sim [loop], scale camera-height")
    assert text.splitlines()[0].strip() == "sim [loop], scale camera-height"
    row = next(each for each in text.splitlines() if "optimised" in each).split()
    snippets, align = T["snippet5"], T["align"]
    assert row[1:5] == [
        f"{snippets['ate_mean']:.4f}",
        "±",
        f"{snippets['ate_std']:.4f}" if snippets["ate_std"] > 5e-5 else f"{snippets['ate_std']:.1e}",
        row[4],
    ]
    assert row[5:10] == [f"{align[name]['ate_rmse_m']:.3f}" for name in ("none", "first", "scale", "6dof", "7dof")]
    assert row[10] == f"{align['7dof']['t_rel_percent']:.2f}"
    assert row[12] == f"{T['evo']['ape_rmse_m_7dof']:.3f}"
    assert len(row) == 14


def test_missing_numbers_are_dashes_with_one_reason_each() -> None:
    text = shown({"network": metrics(50), "odometry": metrics(50), "lidar": None}, "x")
    assert text.count("no segment of 100 m fits") == 1
    assert "– network, odometry: no segment" in text
    assert "– lidar: not recorded." in text
    assert next(each for each in text.splitlines() if "lidar" in each).split() == ["lidar", *["–"] * 11]
