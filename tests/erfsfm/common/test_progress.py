"""Progress of long work: bars on a terminal, lines elsewhere."""

from __future__ import annotations

import io
import re
import sys
import time

import pytest

from erfsfm.common.progress import duration, progress_bar, progress_lines


def test_lines_say_what_is_done_and_the_time_left():
    lines: list[str] = []
    with progress_lines(lines.append, every_s=0.1) as progress:
        for stage, done in (("frames, 1", 1), ("frames, 2", 2), ("loops", 0)):
            time.sleep(0.15)
            progress(stage, done, 100)
            progress(stage, done, 100)
    assert lines[0] == "frames, 1: 1 of 100" and lines[2] == "loops: 0 of 100"
    assert re.fullmatch(r"frames, 2: 2 of 100, 0 min 1\d s left", lines[1])


@pytest.mark.parametrize(
    ("seconds", "words"), [(68, "1 min 8 s"), (9000, "2 h 30 min"), (432_000, "5.0 days")]
)
def test_long_times_are_said_in_hours_and_days(seconds: int, words: str):
    assert duration(seconds) == words


def test_short_work_is_quiet_without_a_terminal(capsys: pytest.CaptureFixture[str]):
    with progress_bar() as progress:
        progress("frames", 1, 2)
        progress("frames", 2, 2)
    assert capsys.readouterr() == ("", "")


def test_a_terminal_has_a_bar_for_each_stage(monkeypatch: pytest.MonkeyPatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("COLUMNS", "100")
    with progress_bar() as progress:
        for done in range(3):
            progress("frames", done, 2)
        progress("map, 7 keyframes", 1, 7)
    shown = terminal.getvalue()
    assert "frames" in shown and "2/2" in shown and "map, 7 keyframes" in shown and "1/7" in shown
