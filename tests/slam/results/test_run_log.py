"""The log of a run is complete from its first line, and its errors never end the run."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from slam.results.folder import run_log

LOGGER = logging.getLogger("slam.test")


def test_lines_from_before_the_folder_are_kept_and_failures_are_written_here_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with run_log() as log:
        LOGGER.info("checked")
        log.begin(tmp_path / "run.log")
        for frame in range(9):
            LOGGER.info("frame %d failed: %s", frame, "no road")
        log.failed("no space")
    LOGGER.warning("after it")
    lines = (tmp_path / "run.log").read_text().splitlines()
    assert [line.split(" ", 2)[2] for line in lines] == [
        "INFO slam.test: checked",
        "INFO slam.test: frame 0 failed: no road",
        "ERROR slam.commands.run: the run failed: no space",
        "INFO slam.commands.run: 9 times: no road",
    ]
    assert "no space" not in caplog.text
