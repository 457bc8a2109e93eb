"""Recordings through ``erfsfm-slam run``: gaps in the numbering."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slam.commands.cli import main

Call = Callable[..., tuple[int, str]]
SETTINGS = ["--set", "mapping.enabled=false", "--set", "output.report=false"]


@pytest.fixture
def run(
    command_line: Callable[..., tuple[int, str, str]],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    tmp_path: Path,
    tiny_weights: Path,
) -> Call:
    """Exit code of ``erfsfm-slam run ARGUMENTS``, its warnings and stderr; one line of error at most."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> tuple[int, str]:
        caplog.clear()
        code, _, err = command_line(main, "erfsfm-slam", "run", "--weights", tiny_weights, *SETTINGS, *arguments)
        assert len([line for line in err.splitlines() if line.startswith("erfsfm-slam: ")]) == (code != 0), err
        return code, caplog.text + err

    return call


def metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def write_kitti(root: Path, name: str, kitti_root: Path) -> Path:
    """The same as a sequence of the real odometry benchmark."""
    shutil.copytree(kitti_root / "sequences/sim", root / "sequences" / name)
    return root


def test_a_gap_in_the_numbering_has_rows_in_the_trajectories(tmp_path: Path, kitti_root: Path, run: Call) -> None:
    root = write_kitti(tmp_path / "root", "00", kitti_root)
    for number in (6, 7):
        (root / f"sequences/00/image_2/{number:06d}.png").unlink()
    code, err = run("--dataset", root, "--output", "out")
    assert code == 0, err
    assert "2 of 14 frames have no image; the first gap is 000006.png to 000007.png" in err
    rows = np.loadtxt(tmp_path / "out/trajectory_optimised.tum.txt")
    assert rows[:, 0] == pytest.approx(0.1 * np.arange(14), abs=1e-6) and np.isfinite(rows).all()
    assert [(gap["first"], gap["last"]) for gap in metrics(tmp_path / "out")["sequence"]["bridged"]] == [(6, 7)]
