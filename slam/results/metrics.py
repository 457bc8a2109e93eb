"""``metrics.json`` and ``loops.json``: their keys, how they are written and read (``docs/metrics.md``)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from slam.config.sections import ScaleMode
from slam.evaluation.depth import DepthMetrics
from slam.evaluation.map import PlacedMetrics
from slam.evaluation.trajectory import TrajectoryMetrics
from slam.runtime.record import Count, Record, part

METRES = "metres"
CAMERA_HEIGHTS = "camera heights"
NO_UNIT = "no metric unit"


class Provenance(Record):
    """Version, command, weights and their training data, where depth comes from, options that name the recording."""

    version: str | None = None
    commit: str | None = None
    command: str | None = None
    seed: Count | None = None
    device: str | None = None
    weights: str | None = None
    weights_sha256: str | None = None
    weights_licence: str | None = None
    trained_on: list[str] | None = None
    leak: bool | None = None
    depth_source: str | None = None
    depth_sha256: str | None = None
    recording: dict[str, str] | None = None


class Stretch(Record):
    """Frames ``first`` to ``last`` and what is about them."""

    first: Count
    last: Count
    reason: str


class SequenceMetrics(Record):
    """Size of the sequence and its true length; interpolated (``bridged``) and doubled frames, segments.

    ``fixed_share`` is the part of the image that is fixed to the camera.
    """

    name: str | None = None
    frames: Count | None = None
    length_m: float | None = None
    fps: float | None = None
    bridged_frames: Count | None = None
    bridged: list[Stretch] | None = None
    doubled: list[Stretch] | None = None
    unreadable_scans: list[Stretch] | None = None
    segments: list[Stretch] | None = None
    fixed_share: float | None = None


class MotionMetrics(Record):
    """Length of the optimised path, speed on average and at most over a second, share of the steps said to stand.

    In the unit of lengths, and in that a second.
    """

    path: float | None = None
    mean_speed: float | None = None
    top_speed: float | None = None
    standing_share: float | None = None


class Timing(Record):
    """Seconds, frames a second over the whole run, processor seconds, peak memory, seconds by stage."""

    seconds_total: float | None = None
    frames_per_second: float | None = None
    cpu_seconds: float | None = None
    peak_rss_mb: float | None = None
    stages: dict[str, float] | None = None


class ScaleMetrics(Record):
    """Unit of length, and the factor from the networks' unit to it."""

    mode: ScaleMode | None = None
    unit: str | None = None
    value: float | None = None
    spread: float | None = None
    frames_used: Count | None = None
    contradicted_steps: Count | None = None


class AgreementMetrics(Record):
    """How far a source contradicts the images or good drives, in sigmas of its noise, and what that is."""

    source: str
    beside: str = "the images"
    sigmas: float | None = None
    figure: str | None = None


class ConfidenceMetrics(Record):
    """Share of drives of this kind that err by at most 1 % of their path.

    ``shape``: by at most the share ``shape_within`` of it after one fitted scale.
    """

    run: float | None = None
    shape: float | None = None
    shape_within: float | None = None


class Trajectories(Record):
    """Errors by trajectory."""

    network: TrajectoryMetrics = part(TrajectoryMetrics)
    odometry: TrajectoryMetrics = part(TrajectoryMetrics)
    optimised: TrajectoryMetrics = part(TrajectoryMetrics)
    lidar: TrajectoryMetrics = part(TrajectoryMetrics)


class Origin(Record):
    """Place and heading of the first camera on the earth."""

    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    heading_deg: float | None = None


class GpsErrors(Record):
    """Distances of a trajectory from the fixes."""

    horizontal_rmse_m: float | None = None
    horizontal_median_m: float | None = None
    vertical_rmse_m: float | None = None


class GpsMetrics(Record):
    """The run beside its GPS track."""

    fixes: Count | None = None
    in_graph: bool | None = None
    origin: Origin = part(Origin)
    odometry: GpsErrors = part(GpsErrors)
    optimised: GpsErrors = part(GpsErrors)


class CoverageMetrics(Record):
    """Share of factors inside so many per cent of their stated noise, and their number where they are of one source."""

    factors: Count | None = None
    inside_50: float | None = Field(default=None, alias="50")
    inside_90: float | None = Field(default=None, alias="90")
    inside_95: float | None = Field(default=None, alias="95")


class GraphMetrics(Record):
    """Size of the graph and coverage of its noise."""

    nodes: Count | None = None
    factors: Count | None = None
    coverage: CoverageMetrics = part(CoverageMetrics)
    coverage_by_source: dict[str, CoverageMetrics] | None = None


class LoopEnds(Record):
    """A loop by its frames."""

    from_: Count = Field(alias="from")
    to: Count
    reason: str = ""


class AcceptedLoop(LoopEnds):
    """A loop with its measured relative pose ``(4, 4)``."""

    T_from_to: list[list[float]] | None = None


class LoopsFile(Record):
    """``loops.json``, as far as it is read back."""

    accepted: list[AcceptedLoop] | None = None


class LoopMetrics(Record):
    """Loops by how far they came."""

    candidates: Count | None = None
    verified: Count | None = None
    accepted: Count | None = None
    rejected: list[LoopEnds] | None = None


class Event(Record):
    """What became of the tracking of keyframes at a frame."""

    frame: Count
    event: str
    other: Count | None = None
    support: Count | None = None


class TrackingMetrics(Record):
    """Keyframes, maps that neither turns nor loops join, and the number of frames that have a pose in one."""

    keyframes: Count | None = None
    maps: Count | None = None
    located_frames: Count | None = None
    events: list[Event] | None = None


class DepthOfKeyframes(Record):
    """Errors of the keyframes' depth, as learned and refined."""

    network: DepthMetrics = part(DepthMetrics)
    refined: DepthMetrics = part(DepthMetrics)


class MapMetrics(PlacedMetrics):
    """The map: its sizes, what filters took, and its errors by the best truth, rigidly moved and ``with_scale``."""

    triangles: Count | None = None
    points: Count | None = None
    blocks: Count | None = None
    submaps: Count | None = None
    frames_fused: Count | None = None
    frames_left_out: Count | None = None
    voxel_size: float | None = None
    filters: dict[str, float] | None = None
    floater_share: float | None = None
    double_wall_share: float | None = None
    truth: str | None = None
    evaluated_m: float | None = None
    with_scale: PlacedMetrics = part(PlacedMetrics)


class Metrics(Record):
    """``metrics.json``, however far the run came."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    status: Literal["running", "estimated", "ok", "failed"] = "ok"
    reason: str | None = None
    provenance: Provenance = part(Provenance)
    sequence: SequenceMetrics = part(SequenceMetrics)
    motion: MotionMetrics = part(MotionMetrics)
    timing: Timing = part(Timing)
    scale: ScaleMetrics = part(ScaleMetrics)
    agreement: list[AgreementMetrics] | None = None
    confidence: ConfidenceMetrics = part(ConfidenceMetrics)
    support: list[float] | None = None
    trajectories: Trajectories = part(Trajectories)
    gps: GpsMetrics = part(GpsMetrics)
    graph: GraphMetrics = part(GraphMetrics)
    loops: LoopMetrics = part(LoopMetrics)
    tracking: TrackingMetrics = part(TrackingMetrics)
    depth_error: list[dict[str, float | None]] | None = None  # of learned depth, at some depths
    depth: DepthOfKeyframes = part(DepthOfKeyframes)
    map: MapMetrics = part(MapMetrics)

    def changed(self, **values: Any) -> Metrics:
        """With other values; None takes one out."""
        own = {
            name: getattr(self, name) for name in self.model_fields_set - {"absent", "reasons"}
        } | values
        reasons = {name: why for name, why in self.reasons.items() if name not in values}
        return Metrics.of(
            **{k: v for k, v in own.items() if v is not None or k in reasons}, reasons=reasons
        )

    def all_errors(self) -> dict[str, TrajectoryMetrics]:
        """Errors by trajectory, also of absent ones."""
        return {name: getattr(self.trajectories, name) for name in Trajectories.names()}

    def evaluated_errors(self) -> dict[str, TrajectoryMetrics]:
        """Errors of the trajectories that have them."""
        return {name: each for name, each in self.all_errors().items() if not each.absent}

    @property
    def failure(self) -> str:
        """Why the run failed or did not end, in one line; empty if it is whole."""
        return (
            "" if self.status == "ok" else " ".join((self.reason or "no reason recorded").split())
        )

    @property
    def unit(self) -> str:
        """``metres``, ``camera heights``, or without a road ``no metric unit`` or ``the networks' own unit``."""
        return self.scale.unit or METRES

    @property
    def is_metric(self) -> bool:
        """Whether lengths are metres."""
        return self.unit == METRES

    def unit_notes(self) -> list[str]:
        """What lengths are in where they are not metres, and how they become metres; empty else."""
        if self.is_metric:
            return []
        why = f"No scale was found ({self.scale.why('value')}): lengths are in {self.unit}, not in metres."
        if self.scale.mode != "none":
            return [why]
        fitted = "Only the alignments with scale (scale, 7 dof) compare with metres. For metres:"
        if self.unit == CAMERA_HEIGHTS:
            why = "Scale mode none: lengths are in camera heights of the learned road plane, not in metres."
            return [
                f"{why} {fitted} camera_height_m in camera.yaml, a GPS track or scale.mode=known."
            ]
        if self.unit == NO_UNIT:
            why = f"No metric unit: {self.scale.frames_used} of {self.sequence.frames} frames see a road."
            known = (
                "--set scale.mode=known --set scale.known_between=[0,50] --set scale.known_m=1.5"
            )
            return [f"{why} {fitted} give the distance of two frames, {known}."]
        return [why]
