"""Every missing number has a reason."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import numpy as np

from slam.results.summary import (
    as_json,
    describe_sequence,
    finite,
)


def sequence_of(stamps: list[float]) -> SimpleNamespace:
    frames = SimpleNamespace(name="00", stamps=np.array(stamps))
    return type("Frames", (SimpleNamespace,), {"__len__": lambda self: len(self.stamps)})(**vars(frames))


def test_sequence_without_truth_or_time_has_the_reasons() -> None:
    summary = describe_sequence(sequence_of([0.0]), None)
    assert summary["length_m"] is None and "true poses" in summary["length_m_reason"]
    assert summary["fps"] is None and summary["fps_reason"]
    standing = describe_sequence(sequence_of([0.0, 0.1]), 0.0)
    assert standing["length_m"] == 0.0 and "length_m_reason" not in standing


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
