"""Tables of one run and of several: the main numbers, and the reasons of missing ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from erfsfm.common.table import Table
from slam.evaluation.trajectory import TrajectoryMetrics, trajectory_metrics
from slam.formats.trajectory import Trajectory
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics
from slam.results.tables import alignments_table, errors_table, motion_line, runs_table

MakeRun = Callable[..., RunFolder]
MakeMetrics = Callable[..., dict[str, Any]]


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Callable[[Table], str]:
    """A table as a pipe gets it."""

    def text(table: Table) -> str:
        table.print()
        return capsys.readouterr().out

    return text


def side_by_side(runs: list[RunFolder]) -> Table:
    return runs_table([(run.path, run.metrics()) for run in runs])


def test_runs_are_shown_side_by_side_with_their_numbers(
    make_run: MakeRun, make_metrics: MakeMetrics, printed: Callable[[Table], str]
):
    text = printed(side_by_side([make_run("first"), make_run("second", make_metrics(mode="none"))]))
    assert "first" in text and "second" in text
    assert text.count("0.870") == 2  # ATE of the optimised trajectories, 7 dof
    assert "Scale mode none" in text and "LEAK" not in text


def test_a_leak_and_missing_numbers_are_noted(
    make_run: MakeRun, make_metrics: MakeMetrics, printed: Callable[[Table], str]
):
    text = printed(side_by_side([make_run("seen", make_metrics(leak=True))]))
    assert "seen, LEAK" in text
    assert (
        "lidar: the sequence has no LiDAR scans" in text
        and "odometry: no segment of 100 m was left" in text
    )


@pytest.mark.parametrize(("status", "word"), [("failed", "failed"), ("estimated", "did not end")])
def test_a_run_that_did_not_end_has_its_reason(
    make_run: MakeRun,
    make_metrics: MakeMetrics,
    printed: Callable[[Table], str],
    status: str,
    word: str,
):
    failed = {
        "schema": 1,
        "status": status,
        "reason": "no motion [bold]between[/bold] frames",
        "provenance": None,
    }
    early = make_run("early", make_metrics() | {"status": status, "reason": "no space left"})
    text = printed(side_by_side([early, make_run("bad", failed)]))
    assert f"bad {word}: no motion [bold]between[/bold] frames" in text
    assert "0.870" in text and f"early {word}: no space left" in text


def errors_of(frames: int) -> TrajectoryMetrics:
    """Errors of a wobbly drive along z."""
    T_world_camera = np.tile(np.eye(4), (frames, 1, 1))
    T_world_camera[:, 2, 3] = np.arange(frames)
    T_world_camera[:, 0, 3] = 5 * np.sin(0.1 * np.arange(frames))
    truth = T_world_camera.copy()
    truth[:, 1, 3] = 0.25 * (-1.0) ** np.arange(frames)
    stamps = np.arange(frames, dtype=np.float64)
    return trajectory_metrics(Trajectory(stamps, T_world_camera), Trajectory(stamps, truth))


def test_the_errors_of_a_run_fit_a_terminal(printed: Callable[[Table], str]):
    errors = errors_of(250)
    lines = printed(
        errors_table({"network": errors, "optimised": errors}, "sim [loop], scale camera-height")
    ).splitlines()
    assert lines[0].strip() == "sim [loop], scale camera-height"
    row = next(line for line in lines if "optimised" in line)
    snippets, align = errors.tree()["snippet5"], errors.tree()["align"]
    assert len(row) <= 80 and row.split()[3:6] == [
        f"{align['7dof']['ate_rmse_m']:.3f}",
        f"{align['6dof']['ate_rmse_m']:.3f}",
        f"{align['7dof']['t_rel_percent']:.2f}",
    ]
    assert float(row.split()[1]) == pytest.approx(snippets["ate_mean"], abs=1e-4)


def test_speeds_are_in_km_h_where_lengths_are_metres():
    motion = {"path": 500.0, "mean_speed": 10.0, "top_speed": 15.0, "standing_share": 0.25}
    assert motion_line(Metrics.of(motion=motion)) == (
        "500.0 m, 36.0 km/h on average, 54.0 at most, standing in 25 % of the steps"
    )
    in_heights = Metrics.of(motion=motion, scale={"unit": "camera heights"})
    assert "10.0 camera heights a second on average" in motion_line(in_heights)
    assert motion_line(Metrics()) == ""


def test_two_files_are_compared_under_every_alignment(printed: Callable[[Table], str]):
    errors = errors_of(250)
    text = printed(alignments_table(errors))
    for name, values in errors.tree()["align"].items():
        row = next(line for line in text.splitlines() if line.split()[:1] == [name]).split()
        assert row[1:3] == [f"{values['ate_rmse_m']:.3f}", f"{values['t_rel_percent']:.2f}"]
        assert len(row) == 1 + len(values)


def test_missing_numbers_are_dashes_with_one_reason_each(printed: Callable[[Table], str]):
    text = printed(
        errors_table(
            {
                "network": errors_of(50),
                "odometry": errors_of(50),
                "lidar": TrajectoryMetrics(absent="not recorded"),
            }
        )
    )
    assert text.count("no segment of 100 m fits") == 1 and "– network, odometry: no segment" in text
    assert "– lidar: not recorded." in text
    assert next(line for line in text.splitlines() if "lidar" in line).split() == [
        "lidar",
        *["–"] * 6,
    ]
