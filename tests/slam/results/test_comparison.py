"""Tables of several runs, with the reasons of missing numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from rich.console import Console

from slam.results.comparison import comparison_table
from slam.results.folder import RunFolder

MakeRun = Callable[..., RunFolder]
MakeMetrics = Callable[..., dict[str, Any]]


def printed(runs: list[RunFolder], width: int = 140) -> str:
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
