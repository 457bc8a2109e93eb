"""Every missing number has a reason."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from slam.results.summary import (
    Provenance,
    as_json,
    describe_sequence,
    describe_start,
    describe_timing,
    finite,
    null,
)
from slam.runtime.timing import Stopwatch


def sequence_of(stamps: list[float]) -> SimpleNamespace:
    frames = SimpleNamespace(name="00", stamps=np.array(stamps))
    return type("Frames", (SimpleNamespace,), {"__len__": lambda self: len(self.stamps)})(**vars(frames))


def test_sequence_in_numbers() -> None:
    assert describe_sequence(sequence_of([5.0, 5.1, 5.2, 5.3, 5.4]), 4.0) == {
        "name": "00",
        "frames": 5,
        "length_m": 4.0,
        "fps": pytest.approx(10.0),
    }


def test_sequence_without_truth_or_time_has_the_reasons() -> None:
    summary = describe_sequence(sequence_of([0.0]), None)
    assert summary["length_m"] is None and "true poses" in summary["length_m_reason"]
    assert summary["fps"] is None and summary["fps_reason"]
    standing = describe_sequence(sequence_of([0.0, 0.1]), 0.0)
    assert standing["length_m"] == 0.0 and "length_m_reason" not in standing


def test_timing() -> None:
    watch = Stopwatch()
    with watch.stage("read"):
        pass
    timing = describe_timing(watch, 10)
    assert timing["frames_per_second"] == pytest.approx(10 / timing["seconds_total"])
    assert set(timing) == {"seconds_total", "frames_per_second", "cpu_seconds", "peak_rss_mb", "stages"}
    assert timing["stages"] == watch.stages and timing["stages"] is not watch.stages


def test_a_run_begins_as_running_with_its_provenance() -> None:
    known = Provenance(
        "1", "abc", "erfsfm-slam run", 0, "cpu", "sim", "9f", None, "MIT", ["simulated/1"], False, "network", "9f"
    )
    begun = describe_start(known)
    assert (begun["status"], begun["schema"]) == ("running", 1) and "has not ended" in begun["reason"]
    assert begun["provenance"]["trained_on"] == ["simulated/1"]
    assert begun["provenance"]["noise_sha256_reason"] == "no noise.yaml was measured with these weights"


def test_not_finite_becomes_null_with_a_reason_at_any_depth() -> None:
    tree = {"a": math.nan, "b": {"c": (1.0, math.inf), "d": np.float64("-inf")}, "e": 2, "f": None}
    clean = finite(tree)
    assert clean == {
        "a": None,
        "a_reason": "the computation gave nan",
        "b": {"c": [1.0, None], "d": None, "d_reason": "the computation gave -inf"},
        "e": 2,
        "f": None,
    }
    assert json.loads(as_json(clean)) == clean
    assert tree["b"]["c"] == (1.0, math.inf)


def test_a_reason_that_is_known_is_not_overwritten() -> None:
    assert finite({"a_reason": "too short", "a": math.nan})["a_reason"] == "too short"
    assert null("ate", "too short") == {"ate": None, "ate_reason": "too short"}


def test_text_refuses_what_is_not_finite() -> None:
    with pytest.raises(ValueError, match="JSON"):
        as_json({"a": math.nan})
