"""The clock of the benchmarks."""

import statistics
import time
from collections.abc import Callable

import pytest
import torch


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture
def cpu_ms() -> Callable[..., list[float]]:
    """Median processor time of each call, milliseconds, after one call to warm up.

    They take turns, so that a machine that slows down slows all of them down.
    """

    def measure(*works: Callable[[], object], runs: int = 3) -> list[float]:
        times: list[list[float]] = [[] for _ in works]
        for run in range(runs + 1):
            for work, spent in zip(works, times):
                start = time.process_time()
                work()
                if run:
                    spent.append((time.process_time() - start) * 1e3)
        return [statistics.median(spent) for spent in times]

    return measure
