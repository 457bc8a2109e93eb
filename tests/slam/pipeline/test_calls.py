"""How often the costly calls are made for a frame: a budget that does not depend on the machine."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import room
from oracle import OracleNoise, OraclePredictor

from slam.config.sections import load_config
from slam.loops.features import FeatureExtractor
from slam.mapping.depth import DepthRefiner
from slam.mapping.submap import Fusion
from slam.pipeline.run import SlamPipeline
from slam.sequences.catalogue import SimulatedSequence
from slam.simulation.options import SimulationOptions

FRAMES = 30
# calls over frames: a step measured by geometry, whose tracks all pass the first search at best
MOST = {
    "depth": 0.6,
    "snippet": 0.3,
    "calcOpticalFlowPyrLK": 5.0,
    "findEssentialMat": 0.5,
    "goodFeaturesToTrack": 12.1,  # one a tile
    "view": 0.3,
    "refine": 0.7,
    "integrate": 0.7,
}


def counted(calls: Counter[str], name: str, of: Callable[..., Any]) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        calls[name] += 1
        return of(*args, **kwargs)

    return call


def test_calls_a_frame(monkeypatch: pytest.MonkeyPatch):
    sequence, calls = (
        SimulatedSequence(SimulationOptions("grid", FRAMES, 610, 312, 96)),
        Counter[str](),
    )

    def depth_of(index: int) -> np.ndarray:
        depth = sequence.street.depth(index)
        return np.where(depth > 0, depth, 200.0)

    oracle = OraclePredictor(sequence.reference, depth_of, OracleNoise(), 0.2)
    for owner, name in (
        *(
            (cv2, name)
            for name in ("calcOpticalFlowPyrLK", "findEssentialMat", "goodFeaturesToTrack")
        ),
        (oracle, "depth"),
        (oracle, "snippet"),
        (FeatureExtractor, "view"),
        (DepthRefiner, "refine"),
        (Fusion, "integrate"),
    ):
        monkeypatch.setattr(owner, name, counted(calls, name, getattr(owner, name)))
    SlamPipeline(sequence, oracle, load_config(None, [])).run()
    a_frame = {name: calls[name] / FRAMES for name in MOST}
    assert all(a_frame.values())
    assert {name: calls for name, calls in a_frame.items() if calls > MOST[name]} == {}


def test_calls_a_frame_of_a_hand_held_camera(monkeypatch: pytest.MonkeyPatch):
    """Two searches of corners for the frame; for a keyframe, two in each keyframe that still finds some of them."""
    truth, calls = room.walk(40), Counter[str]()
    monkeypatch.setattr(
        cv2, "calcOpticalFlowPyrLK", counted(calls, "flow", cv2.calcOpticalFlowPyrLK)
    )
    keyframes = room.tracked(truth).segments[-1].keyframes
    assert 0 < calls["flow"] <= 2 * len(truth) + 16 * len(keyframes)
