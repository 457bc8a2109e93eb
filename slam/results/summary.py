"""Parts of ``metrics.json``: inputs, gaps, timing; every missing number has a reason."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from slam.frames import Sequence, runs
from slam.runtime.timing import Stopwatch, peak_rss_mb

SCHEMA = 1


@dataclass(frozen=True)
class Provenance:
    """Version, command, weights and their training data, where depth comes from, and where the recording is.

    ``noise_sha256`` is that of the noise model beside the weights, None without one. ``recording`` holds ``dataset``,
    ``sequence`` and ``camera`` as far as they were given; none for the embedded street.
    """

    version: str
    commit: str
    command: str
    seed: int
    device: str
    weights: str
    weights_sha256: str
    noise_sha256: str | None
    weights_licence: str
    trained_on: list[str]
    leak: bool
    depth_source: str
    depth_sha256: str
    recording: dict[str, str] = field(default_factory=dict)

    def described(self) -> dict[str, Any]:
        """As in ``metrics.json``."""
        reason = {} if self.noise_sha256 else null("noise_sha256", "no noise.yaml was measured with these weights")
        return asdict(self) | reason


def null(name: str, reason: str) -> dict[str, Any]:
    """A missing number and its reason."""
    return {name: None, f"{name}_reason": reason}


def describe_sequence(sequence: Sequence, length_m: float | None) -> dict[str, Any]:
    """Name, size and true length of a sequence."""
    frames = len(sequence)
    span = float(sequence.stamps[-1] - sequence.stamps[0]) if frames > 1 else 0.0
    summary: dict[str, Any] = {"name": sequence.name, "frames": frames}
    summary |= {"length_m": length_m} if length_m is not None else null("length_m", "the sequence has no true poses")
    summary |= {"fps": (frames - 1) / span} if span > 0 else null("fps", "all stamps are equal")
    return summary


def describe_gaps(frames: Mapping[int, str]) -> dict[str, Any]:
    """Number of interpolated frames, and the gaps with the reason of their first frame."""
    return {"bridged_frames": len(frames), "bridged": describe_frames(frames)}


def describe_frames(reasons: Mapping[int, str]) -> list[dict[str, Any]]:
    """Consecutive frames with the reason of the first."""
    return [{"first": first, "last": last, "reason": reasons[first]} for first, last in runs(reasons)]


def describe_timing(watch: Stopwatch, frames: int) -> dict[str, Any]:
    """Seconds, frames a second over the whole run, processor seconds, peak memory, seconds by stage."""
    seconds, peak = watch.seconds, peak_rss_mb()
    timing = {"seconds_total": seconds, "frames_per_second": frames / seconds, "cpu_seconds": watch.cpu_seconds}
    memory = null("peak_rss_mb", "not available on Windows") if peak is None else {"peak_rss_mb": peak}
    return timing | memory | {"stages": dict(watch.stages)}


def describe_start(provenance: Provenance) -> dict[str, Any]:
    """``metrics.json`` until the trajectories are whole."""
    return {
        "schema": SCHEMA,
        "status": "running",
        "reason": "the run has not ended, or was killed before its trajectories were written",
        "provenance": provenance.described(),
    }


def finite(tree: Any) -> Any:
    """A copy in which every number that is not finite is null with a reason."""
    if isinstance(tree, dict):
        clean: dict[str, Any] = {}
        for key, value in tree.items():
            clean[key] = finite(value)
            if isinstance(value, float) and not math.isfinite(value):
                clean.setdefault(f"{key}_reason", f"the computation gave {value}")
        return clean
    if isinstance(tree, list | tuple):
        return [finite(value) for value in tree]
    if isinstance(tree, float) and not math.isfinite(tree):
        return None
    return tree


def as_json(metrics: dict[str, Any]) -> str:
    """The metrics as text; ``ValueError`` for a number that is not finite."""
    return json.dumps(metrics, indent=2, allow_nan=False)
