"""Freed memory goes back to the system."""

from __future__ import annotations

import mmap
import sys
from pathlib import Path

import numpy as np
import pytest

from slam.runtime.memory import return_freed_memory


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE


@pytest.mark.skipif(sys.platform != "linux", reason="other C libraries return memory by themselves")
def test_memory_between_blocks_in_use_goes_back() -> None:
    blocks = [np.ones(12_000, np.uint8) for _ in range(20_000)]
    full = resident_bytes()
    blocks = blocks[::20]  # what stays lies in between, and holds the heap
    return_freed_memory()
    assert full - resident_bytes() > 100e6 and len(blocks) == 1000
