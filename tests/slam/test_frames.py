"""The small records between the parts."""

from __future__ import annotations

from slam.frames import runs


def test_runs_of_frames() -> None:
    assert runs({7, 3, 4, 9, 8}) == [(3, 4), (7, 9)] and runs(()) == []
