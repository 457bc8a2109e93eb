"""Times add up by stage."""

from __future__ import annotations

import time

import pytest

from slam.runtime.timing import Stopwatch, peak_rss_mb


def test_a_stage_adds_up_over_its_visits_also_when_it_fails() -> None:
    watch = Stopwatch()
    with watch.stage("read"):
        time.sleep(0.02)
    with pytest.raises(ZeroDivisionError), watch.stage("read"):
        time.sleep(0.02)
        _ = 1 / 0
    with watch.stage("map"):
        pass
    assert list(watch.stages) == ["read", "map"]
    assert 0.04 <= watch.stages["read"] <= watch.seconds
    assert watch.stages["map"] < watch.stages["read"]


def test_processor_time_is_work_not_waiting() -> None:
    watch = Stopwatch()
    time.sleep(0.1)
    waited = watch.cpu_seconds
    end = time.process_time() + 0.1
    while time.process_time() < end:
        pass
    assert waited < 0.08 < watch.cpu_seconds - waited


def test_peak_memory_is_in_mebibytes_and_never_falls() -> None:
    before = peak_rss_mb()
    assert 20 < before < 100_000
    block = bytearray(64 * 2**20)
    block[::4096] = b"x" * len(block[::4096])
    assert peak_rss_mb() >= before
