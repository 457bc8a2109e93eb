"""Weights fine-tuned on a user's drive, from the command to the comparison of depth before and after."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from typer.testing import CliRunner

from erfsfm.cli import app
from erfsfm.inference import DepthPosePredictor
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import write_kitti_root
from slam.simulation.street import SimulatedStreet

SMALL = ("steps=2", "batch=2", "validate_every=2")
SMALL_DATA = ("workers=0", "validation_share=0.45")


@pytest.mark.slow
def test_own_fine_tunes_default_on_any_drive(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    street = SimulatedStreet(SimulationOptions("straight", 44, 77))
    write_kitti_root(street, tmp_path / "drive")
    settings = [f"training.{each}" for each in SMALL] + [f"data.{each}" for each in SMALL_DATA]
    command = [
        "train",
        "--config",
        "own",
        "--dataset",
        str(tmp_path / "drive"),
        "--output",
        str(tmp_path / "own"),
    ]
    with caplog.at_level(logging.INFO):
        done = CliRunner().invoke(
            app, [*command, "--device", "cpu", *(f"--set={each}" for each in settings)]
        )
    assert done.exit_code == 0, done.output
    assert "a step takes" in caplog.text
    cells = {line.split()[0]: line.split() for line in done.stdout.splitlines() if line.split()}
    head, before, after = (cells[name] for name in ("depth", "before", "after"))
    assert head[:3] == ["depth", "recording", "abs_rel"]
    assert [before[:2], after[:2]] == [
        ["before", "simulated/77[24:44]"],
        ["after", "simulated/77[24:44]"],
    ]
    assert before[2] != after[2] and float(after[2]) < 0.3
    assert DepthPosePredictor.from_weights(str(tmp_path / "own")).record.trained_on
