"""Tables and conclusions of the receptive-field study."""

import importlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
study = importlib.import_module("study_receptive_field")


def study_rows(better: float) -> list:
    """Three seeds of every variant, equal but for a pose network whose rotation error is smaller by a ratio."""
    rng = np.random.default_rng(0)
    found = []
    for seed in range(3):
        for depth, pose in study.PAIRS:
            plain = study.StudyRow(depth, pose, seed, 0.04, 0.02 * (1 + 0.02 * rng.standard_normal()), 0.2, 100.0)
            found.append(replace(plain, re=plain.re * (1 - better)) if pose == "erf-posenet-dfcv2" else plain)
    return found


def test_a_large_gain_is_named_and_noise_is_not():
    lines = study.conclusions(study_rows(better=0.3)).splitlines()
    (gain,) = [line for line in lines if "dfcv2` against `posenet`: snippet RE" in line]
    assert gain.endswith("better.")
    assert not [
        line for line in study.conclusions(study_rows(better=0.0)).splitlines() if line.endswith(("better.", "worse."))
    ]


def test_every_variant_has_a_row_with_its_deviation():
    rows = study.table(study_rows(better=0.0), "pose", width=0.5).splitlines()[2:]
    assert len(rows) == 4 and all("0.0400 ± 0.0000" in row for row in rows)


def test_the_picture_is_drawn(tmp_path: Path):
    study.draw(tmp_path / "study.png", study_rows(better=0.1))
    assert (tmp_path / "study.png").stat().st_size > 5000
