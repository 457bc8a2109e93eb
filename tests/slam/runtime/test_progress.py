"""Progress of long work where there is no terminal."""

from __future__ import annotations

import logging

import pytest

from slam.runtime.progress import ProgressLines, progress_bar


def test_a_line_every_ten_seconds_with_rate_and_time_left() -> None:
    lines: list[str] = []
    seconds = iter(range(0, 1000, 4))
    progress = ProgressLines(lines.append, lambda: float(next(seconds)))
    for done in range(1, 8):
        progress("frames", done, 100)
    assert lines == [
        "frames: 4 of 100, 0.25 a second, 6 min 24 s left",
        "frames: 7 of 100, 0.25 a second, 6 min 12 s left",
    ]
    for done in range(1, 3):
        progress("map", done, 2)
    assert len(lines) == 2  # it was over within ten seconds


def test_short_work_is_quiet_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar() as progress:
        progress("frames", 1, 2)
        progress("frames", 2, 2)
    assert capsys.readouterr() == ("", "")


def test_run_slam_logs_its_progress(caplog: pytest.LogCaptureFixture) -> None:
    from slam.commands.run.run import logged_progress

    seconds = iter((0.0, 20.0))
    with caplog.at_level(logging.INFO):
        progress = logged_progress(lambda: next(seconds))
        progress("frames", 1, 9)
        progress("frames", 3, 9)
    assert caplog.messages == ["frames: 3 of 9, 0.1 a second, 1 min 0 s left"]
