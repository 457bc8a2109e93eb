"""Tables and conclusions of the receptive-field study."""

import importlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
study = importlib.import_module("study_receptive_field")


def study_rows(ratio: float, noise: float = 0.02) -> list:
    """Eight seeds of every network; seeds differ by a lot in common, and one network's rotation error by a ratio."""
    rng = np.random.default_rng(0)
    found = []
    for seed in range(8):
        common = np.exp(0.3 * rng.standard_normal())
        for pose in study.NETWORKS:
            errors = 0.02 * common * np.exp(noise * rng.standard_normal(4))
            row = study.StudyRow(pose, seed, *errors, 100.0)
            found.append(replace(row, real_re=row.real_re * ratio) if pose == "erf-posenet-dfc" else row)
    return found


def test_the_interval_holds_the_ratio():
    rows = study_rows(0.8)
    runs = study.by_network(rows)
    ratio, low, high = study.ratio_interval(runs["posenet"], runs["erf-posenet-dfc"], "real_re")
    assert ratio == pytest.approx(0.8, rel=0.03) and low < ratio < high and high - low < 0.06
    few = {name: each[:2] for name, each in runs.items()}
    _, low_of_few, high_of_few = study.ratio_interval(few["posenet"], few["erf-posenet-dfc"], "real_re")
    assert low_of_few < low and high < high_of_few
    *_, last = study.differences(rows).splitlines()
    assert last.startswith("| `erf-posenet-dfc` / `posenet` |") and f"{ratio:.2f} ({low:.2f} to {high:.2f})" in last


def test_every_network_has_a_row_with_its_deviation():
    rows = study.table([replace(row, real_ate=0.04) for row in study_rows(1.0)], width=0.5).splitlines()[2:]
    assert len(rows) == len(study.NETWORKS) and all("0.0400 ± 0.0000" in row for row in rows)
