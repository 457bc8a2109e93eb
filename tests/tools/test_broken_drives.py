"""Broken drives are reported and cost little over the frames that show the road."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

import broken_drives as tool


@pytest.mark.slow
def test_reported_and_within_three_times_the_clean_drive() -> None:
    clean, sequence = tool.simulated(tool.FRAMES, tool.SEED)
    whole = tool.examine("clean", clean, sequence, "sim")
    assert whole.reported == () and whole.ate_rmse_m is not None
    for fault in ("black", "noise", "frozen exact", "frozen, encoded each time", "upside down", "mirrored"):
        found = tool.examine(fault, tool.FAULTS[fault](clean), sequence, "sim")
        assert found.reported, fault
        assert found.ate_rmse_m is not None and found.ate_rmse_m < 3 * whole.ate_rmse_m, fault


@pytest.mark.slow
def test_a_cut_begins_a_segment_and_stamps_out_of_order_are_refused() -> None:
    clean, sequence = tool.simulated(120, tool.SEED)
    cut = tool.examine("cut", tool.FAULTS["cut to another place"](clean), sequence, "sim")
    assert "a new segment of the drive begins at frame 60" in cut.reported[0]
    refused = tool.examine("stamps", tool.swapped_stamps(clean, 50), sequence, "sim")
    assert refused.ate_rmse_m is None and "times.txt row 52" in refused.reported[0]
