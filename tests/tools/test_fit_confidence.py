"""The fit finds how large a contradiction half of the drives survive."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from slam.frontend.agreement import CONFIDENCE, share_right

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
tool = importlib.import_module("fit_confidence")


def test_the_fit_finds_the_contradiction_that_halves_the_confidence() -> None:
    best, _, steepness = CONFIDENCE
    rng = np.random.default_rng(0)
    sigmas = rng.uniform(0.0, 4.0, 1000)
    truth = share_right(sigmas, (best, 2.0, steepness))
    errors = np.where(rng.random(1000) < truth, 0.002, 0.05)
    found = [tool.Outcome(f"{k}, night", float(s), float(e)) for k, (s, e) in enumerate(zip(sigmas, errors))]
    fitted = tool.fit(found)
    assert fitted[1] == pytest.approx(2.0, rel=0.05)
    assert tool.brier(found, share_right(sigmas, fitted)) < 0.5 * tool.brier(found, np.full(1000, np.mean(truth)))
