"""Tables of one run and of several: all numbers, and the reasons of missing ones."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from slam.evaluation.trajectory import TrajectoryMetrics, trajectory_metrics
from slam.formats.trajectory import Trajectory
from slam.results.folder import RunFolder
from slam.results.terminal_tables import comparison_table, metrics_table

MakeRun = Callable[..., RunFolder]
MakeMetrics = Callable[..., dict[str, Any]]


def printed(runs: list[RunFolder], width: int = 160) -> str:
    console = Console(width=width, record=True, file=None, quiet=False, force_terminal=False)
    with console.capture() as capture:
        console.print(comparison_table(runs))
    return capture.get()


def test_runs_are_shown_side_by_side_with_their_numbers(make_run: MakeRun, make_metrics: MakeMetrics) -> None:
    text = printed([make_run("first"), make_run("second", make_metrics(mode="none"))])
    assert "first" in text
    assert "second" in text
    assert text.count("0.870") == 2  # ATE of the optimised trajectories, 7 dof
    assert "Scale mode none" in text
    assert "LEAK" not in text


def test_a_leak_and_missing_numbers_are_noted(make_run: MakeRun, make_metrics: MakeMetrics) -> None:
    text = printed([make_run("seen", make_metrics(leak=True))])
    assert "LEAK" in text
    assert "lidar: the sequence has no LiDAR scans" in text
    assert "odometry: no segment of 100 m was left" in text


def test_a_failed_run_has_its_row(make_run: MakeRun) -> None:
    failed = {"schema": 1, "status": "failed", "reason": "no motion [bold]between[/bold] frames", "provenance": None}
    text = printed([make_run("good"), make_run("bad", failed)])
    assert "bad failed: no motion [bold]between[/bold] frames" in text
    assert "0.870" in text


@pytest.mark.parametrize(("status", "word"), [("failed", "failed"), ("estimated", "did not end")])
def test_numbers_of_a_run_that_did_not_end_are_shown_with_its_reason(
    make_run: MakeRun, make_metrics: MakeMetrics, status: str, word: str
) -> None:
    text = printed([make_run("early", make_metrics() | {"status": status, "reason": "no space left"})])
    assert "0.870" in text and word in text and f"early {word}: no space left" in text


def errors_of(frames: int, reference: bool = True) -> TrajectoryMetrics:
    """Errors of a wobbly drive along z."""
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
    T = errors_of(250)
    text = shown({"network": T, "optimised": T}, "sim [loop], scale camera-height")
    assert text.splitlines()[0].strip() == "sim [loop], scale camera-height"
    row = next(each for each in text.splitlines() if "optimised" in each).split()
    snippets, align, evo = (T.tree()[key] for key in ("snippet5", "align", "evo"))
    assert row[1:5] == [
        f"{snippets['ate_mean']:.4f}",
        "±",
        f"{snippets['ate_std']:.4f}" if snippets["ate_std"] > 5e-5 else f"{snippets['ate_std']:.1e}",
        row[4],
    ]
    assert row[5:10] == [f"{align[name]['ate_rmse_m']:.3f}" for name in ("none", "first", "scale", "6dof", "7dof")]
    assert row[10] == f"{align['7dof']['t_rel_percent']:.2f}"
    assert row[14] == f"{evo['ape_rmse_m_7dof']:.3f}"
    assert len(row) == 16


def test_missing_numbers_are_dashes_with_one_reason_each() -> None:
    text = shown(
        {"network": errors_of(50), "odometry": errors_of(50), "lidar": TrajectoryMetrics(absent="not recorded")}, "x"
    )
    assert text.count("no segment of 100 m fits") == 1
    assert "– network, odometry: no segment" in text
    assert "– lidar: not recorded." in text
    assert next(each for each in text.splitlines() if "lidar" in each).split() == ["lidar", *["–"] * 13]


@pytest.mark.parametrize("width", [60, 80, 100])
def test_a_narrow_terminal_turns_the_table_and_cuts_nothing(make_run: MakeRun, width: int) -> None:
    wide = printed([make_run("morning"), make_run("b")], 300)
    narrow = printed([make_run("morning"), make_run("b")], width)
    numbers = sorted(word for word in wide.split() if word[0].isdigit() and "." in word)
    assert sorted(word for word in narrow.split() if word[0].isdigit() and "." in word) == numbers and len(numbers) > 40
    assert "…" not in narrow and max(map(len, narrow.splitlines())) <= width
    assert "t_rel % 7dof" in narrow
