"""The JSON files of a run folder, as far as they are read back; ``docs/metrics.md`` describes every key."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from slam.config.sections import ScaleMode

Count = Annotated[int, Field(ge=0)]


class _Part(BaseModel):
    """Keys that are read; others are allowed, missing ones are null. JSON's own kinds are not converted."""

    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)


class Recording(_Part):
    """Options that name the recording."""

    dataset: str | None = None
    sequence: str | None = None
    camera: str | None = None
    gps: str | None = None
    frames: str | None = None


class ProvenanceRecord(_Part):
    """The program, weights and command of a run."""

    seed: Count | None = None
    weights: str | None = None
    weights_sha256: str | None = None
    noise_sha256: str | None = None
    weights_licence: str | None = None
    trained_on: list[str] | None = None
    leak: bool | None = None
    depth_source: str | None = None
    depth_sha256: str | None = None
    recording: Recording | None = None


class Gap(_Part):
    """Interpolated frames."""

    first: Count
    last: Count
    reason: str


class SequenceRecord(_Part):
    """The sequence of a run."""

    name: str | None = None
    frames: Count | None = None
    length_m: float | None = None
    fps: float | None = None
    bridged_frames: Count | None = None
    bridged: list[Gap] | None = None
    doubled: list[Gap] | None = None
    unreadable_scans: list[Gap] | None = None
    continued_at: Count | None = None
    segments: list[Gap] | None = None


class ScaleRecord(_Part):
    """Unit of length."""

    mode: ScaleMode | None = None
    value: float | None = None


class AlignedErrors(_Part):
    """Errors under one alignment."""

    ate_rmse_m: float | None = None
    t_rel_percent: float | None = None
    r_rel_deg_per_100m: float | None = None
    rpe_trans_m: float | None = None
    rpe_rot_deg: float | None = None
    scale: float | None = None


class SnippetRecord(_Part):
    """Errors of snippets."""

    ate_mean: float | None = None
    ate_std: float | None = None
    re_mean: float | None = None
    re_std: float | None = None
    count: Count | None = None


class TrajectoryErrors(_Part):
    """The object T."""

    snippet5: SnippetRecord | None = None
    align: dict[str, AlignedErrors | str | None] | None = None
    evo: dict[str, float | str | None] | None = None


class LoopEnds(_Part):
    """A loop by its frames."""

    from_: Count = Field(alias="from")
    to: Count
    reason: str | None = None
    inliers: Count | None = None
    score: float | None = None


class LoopCounts(_Part):
    """Loops in ``metrics.json``."""

    candidates: Count | None = None
    verified: Count | None = None
    accepted: Count | None = None
    rejected: list[LoopEnds] | None = None


class EventRecord(_Part):
    """An event in the tracking of keyframes at a frame."""

    frame: Count
    event: str
    other: Count | None = None
    support: Count | None = None


class TrackingRecord(_Part):
    """Keyframes and their maps."""

    keyframes: Count | None = None
    maps: Count | None = None
    events: list[EventRecord] = []


class GraphRecord(_Part):
    """Size of the graph and coverage of its noise."""

    nodes: Count | None = None
    factors: Count | None = None
    coverage: dict[str, float | str | None] | None = None
    coverage_by_source: dict[str, dict[str, float | str | None] | str | None] | None = None


class MetricsFile(_Part):
    """``metrics.json``."""

    schema_: Literal[1] = Field(default=1, alias="schema")
    status: Literal["running", "estimated", "ok", "failed"] = "ok"
    reason: str | None = None
    provenance: ProvenanceRecord | None = None
    sequence: SequenceRecord | None = None
    timing: dict[str, float | str | dict[str, float] | None] | None = None
    scale: ScaleRecord | None = None
    trajectories: dict[str, TrajectoryErrors | str | None] | None = None
    graph: GraphRecord | None = None
    loops: LoopCounts | None = None
    tracking: TrackingRecord | None = None
    depth: dict[str, dict[str, object] | str | None] | None = None
    map: dict[str, object] | None = None


class LoopsFile(_Part):
    """``loops.json``."""

    accepted: list[LoopEnds] = []
    rejected: list[LoopEnds] = []
    rejected_left_out: int = 0
