"""Times add up by stage."""

from __future__ import annotations

import time

import pytest

from slam.runtime.stopwatch import Stopwatch


def test_a_stage_adds_up_over_its_visits_also_when_it_fails():
    watch = Stopwatch()
    with watch.stage("read"):
        time.sleep(0.001)
    once = watch.stages["read"]
    with pytest.raises(ZeroDivisionError), watch.stage("read"):
        _ = 1 / 0
    with watch.stage("map"):
        pass
    assert list(watch.stages) == ["read", "map"]
    assert 0 < once < watch.stages["read"]
    assert sum(watch.stages.values()) <= watch.seconds
