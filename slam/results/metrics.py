"""``metrics.json`` and ``loops.json``: their keys, how they are written and read (``docs/metrics.md``)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from slam.config.sections import ScaleMode
from slam.evaluation.depth import DepthMetrics
from slam.evaluation.map import PlacedMetrics, ScaledMetrics
from slam.evaluation.trajectory import TrajectoryMetrics
from slam.runtime.storage.record import MISSING, Count, Known, Missing, Record, known

METRES = "metres"
CAMERA_HEIGHTS = "camera heights"
NO_UNIT = "no metric unit"


class Recording(Record):
    """Options that name the recording; none for the embedded street."""

    dataset: Known[str] = MISSING
    camera: Known[str] = MISSING
    gps: Known[str] = MISSING
    sequence: Known[str] = MISSING
    frames: Known[str] = MISSING
    truth: Known[str] = MISSING


class Provenance(Record):
    """Version, command, weights and their training data, and where depth comes from."""

    version: Known[str] = MISSING
    commit: Known[str] = MISSING
    command: Known[str] = MISSING
    seed: Known[Count] = MISSING
    device: Known[str] = MISSING
    weights: Known[str] = MISSING
    weights_sha256: Known[str] = MISSING
    weights_licence: Known[str] = MISSING
    trained_on: Known[list[str]] = MISSING
    leak: Known[bool] = MISSING
    depth_source: Known[str] = MISSING
    depth_sha256: Known[str] = MISSING
    recording: Known[Recording] = MISSING


class Stretch(Record):
    """Frames ``first`` to ``last`` and what is about them."""

    first: Count
    last: Count
    reason: str


class SequenceMetrics(Record):
    """Size of the sequence and its true length; interpolated (``bridged``) and doubled frames, segments."""

    name: Known[str] = MISSING
    frames: Known[Count] = MISSING
    length_m: Known[float] = MISSING
    fps: Known[float] = MISSING
    bridged_frames: Known[Count] = MISSING
    bridged: Known[list[Stretch]] = MISSING
    doubled: Known[list[Stretch]] = MISSING
    unreadable_scans: Known[list[Stretch]] = MISSING
    segments: Known[list[Stretch]] = MISSING


class Timing(Record):
    """Seconds, frames a second over the whole run, processor seconds, peak memory, seconds by stage."""

    seconds_total: Known[float] = MISSING
    frames_per_second: Known[float] = MISSING
    cpu_seconds: Known[float] = MISSING
    peak_rss_mb: Known[float] = MISSING
    stages: Known[dict[str, float]] = MISSING


class ScaleMetrics(Record):
    """Unit of length, and the factor from the networks' unit to it."""

    mode: Known[ScaleMode] = MISSING
    unit: Known[str] = MISSING
    value: Known[float] = MISSING
    spread: Known[float] = MISSING
    frames_used: Known[Count] = MISSING
    contradicted_steps: Known[Count] = MISSING


class AgreementMetrics(Record):
    """How far a source contradicts the images or good drives, in sigmas of its noise, and what that is."""

    source: str
    beside: str = "the images"
    sigmas: Known[float] = MISSING
    figure: Known[str] = MISSING


class ConfidenceMetrics(Record):
    """Share of drives of this kind that err by at most 1 % of their path."""

    run: Known[float] = MISSING


class Trajectories(Record):
    """Errors by trajectory."""

    network: Known[TrajectoryMetrics] = MISSING
    odometry: Known[TrajectoryMetrics] = MISSING
    optimised: Known[TrajectoryMetrics] = MISSING
    lidar: Known[TrajectoryMetrics] = MISSING


class Origin(Record):
    """Place and heading of the first camera on the earth."""

    latitude_deg: Known[float] = MISSING
    longitude_deg: Known[float] = MISSING
    altitude_m: Known[float] = MISSING
    heading_deg: Known[float] = MISSING


class GpsErrors(Record):
    """Distances of a trajectory from the fixes."""

    horizontal_rmse_m: Known[float] = MISSING
    horizontal_median_m: Known[float] = MISSING
    vertical_rmse_m: Known[float] = MISSING


class GpsMetrics(Record):
    """The run beside its GPS track."""

    fixes: Known[Count] = MISSING
    in_graph: Known[bool] = MISSING
    origin: Known[Origin] = MISSING
    odometry: Known[GpsErrors] = MISSING
    optimised: Known[GpsErrors] = MISSING


class CoverageMetrics(Record):
    """Share of factors inside so many per cent of their stated noise, and their number where they are of one source."""

    factors: Known[Count] = MISSING
    inside_50: Known[float] = Field(default=MISSING, alias="50")
    inside_90: Known[float] = Field(default=MISSING, alias="90")
    inside_95: Known[float] = Field(default=MISSING, alias="95")


class GraphMetrics(Record):
    """Size of the graph and coverage of its noise."""

    nodes: Known[Count] = MISSING
    factors: Known[Count] = MISSING
    coverage: Known[CoverageMetrics] = MISSING
    coverage_by_source: Known[dict[str, CoverageMetrics]] = MISSING


class LoopEnds(Record):
    """A loop by its frames."""

    from_: Count = Field(alias="from")
    to: Count
    reason: str = ""


class AcceptedLoop(LoopEnds):
    """A loop with its measured relative pose ``(4, 4)``."""

    T_from_to: Known[list[list[float]]] = MISSING


class LoopsFile(Record):
    """``loops.json``, as far as it is read back."""

    accepted: Known[list[AcceptedLoop]] = MISSING
    rejected_left_out: Known[Count] = MISSING


class LoopMetrics(Record):
    """Loops by how far they came."""

    candidates: Known[Count] = MISSING
    verified: Known[Count] = MISSING
    accepted: Known[Count] = MISSING
    rejected: Known[list[LoopEnds]] = MISSING


class Event(Record):
    """What became of the tracking of keyframes at a frame."""

    frame: Count
    event: str
    other: Count | None = None
    support: Count | None = None


class TrackingMetrics(Record):
    """Keyframes, maps that neither turns nor loops join, and the number of frames that have a pose in one."""

    keyframes: Known[Count] = MISSING
    maps: Known[Count] = MISSING
    located_frames: Known[Count] = MISSING
    events: Known[list[Event]] = MISSING


class LearnedDepthError(Record):
    """Bias and relative sigma of learned depth at one depth."""

    depth: Known[float] = MISSING
    bias: Known[float] = MISSING
    sigma: Known[float] = MISSING
    corners: Known[float] = MISSING


class DepthOfKeyframes(Record):
    """Errors of the keyframes' depth, as learned and refined."""

    network: Known[DepthMetrics] = MISSING
    refined: Known[DepthMetrics] = MISSING


class MapSizes(Record):
    """Sizes of the map, and what filters took."""

    triangles: Known[Count] = MISSING
    points: Known[Count] = MISSING
    blocks: Known[Count] = MISSING
    submaps: Known[Count] = MISSING
    frames_fused: Known[Count] = MISSING
    frames_left_out: Known[Count] = MISSING
    voxel_size: Known[float] = MISSING
    filters: Known[dict[str, float]] = MISSING
    floater_share: Known[float] = MISSING
    double_wall_share: Known[float] = MISSING


class MapErrors(PlacedMetrics):
    """Errors of the map by the best truth that there is, after a rigid motion and after one with a scale."""

    truth: Known[str] = MISSING
    evaluated_m: Known[float] = MISSING
    with_scale: Known[ScaledMetrics] = MISSING


class MapMetrics(MapErrors, MapSizes):
    """The map: its sizes and its errors."""


class Metrics(Record):
    """``metrics.json``, however far the run came."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    status: Literal["running", "estimated", "ok", "failed"] = "ok"
    reason: Known[str] = MISSING
    provenance: Known[Provenance] = MISSING
    sequence: Known[SequenceMetrics] = MISSING
    timing: Known[Timing] = MISSING
    scale: Known[ScaleMetrics] = MISSING
    agreement: Known[list[AgreementMetrics]] = MISSING
    confidence: Known[ConfidenceMetrics] = MISSING
    support: Known[list[float]] = MISSING
    trajectories: Known[Trajectories] = MISSING
    gps: Known[GpsMetrics] = MISSING
    graph: Known[GraphMetrics] = MISSING
    loops: Known[LoopMetrics] = MISSING
    tracking: Known[TrackingMetrics] = MISSING
    depth_error: Known[list[LearnedDepthError]] = MISSING
    depth: Known[DepthOfKeyframes] = MISSING
    map: Known[MapMetrics] = MISSING

    @classmethod
    def of_begun_run(cls, provenance: Provenance) -> Metrics:
        """Those of a run until its trajectories are whole."""
        reason = "the run has not ended, or was killed before its trajectories were written"
        return cls(schema_=1, status="running", reason=reason, provenance=provenance)

    def changed(self, **values: Any) -> Metrics:
        """With other values; None takes one out."""
        own = {name: getattr(self, name) for name in self.model_fields_set} | values
        return Metrics(**{name: value for name, value in own.items() if value is not None})

    def all_errors(self) -> dict[str, TrajectoryMetrics | Missing]:
        """Errors by trajectory, or the reasons of missing ones."""
        return {name: getattr(self.trajectories, name) for name in Trajectories.model_fields}

    def evaluated_errors(self) -> dict[str, TrajectoryMetrics | Missing]:
        """Errors of the trajectories that have them."""
        return {name: errors for name, errors in self.all_errors().items() if not isinstance(errors, Missing)}

    @property
    def failure(self) -> str:
        """Why the run failed or did not end, in one line; empty if it is whole."""
        return "" if self.status == "ok" else " ".join((known(self.reason) or "no reason recorded").split())

    @property
    def unit(self) -> str:
        """``metres``, ``camera heights``, or without a road ``no metric unit`` or ``the networks' own unit``."""
        return known(self.scale.unit) or METRES

    @property
    def is_metric(self) -> bool:
        """Whether lengths are metres."""
        return self.unit == METRES

    def unit_notes(self) -> list[str]:
        """Notes on the unit of length."""
        if self.scale.mode == "none" and self.unit == CAMERA_HEIGHTS:
            return [
                "Scale mode none: lengths of odometry, optimised and the map are in camera heights of the learned road "
                "plane, not in metres; only the alignments with scale (scale, 7 dof) compare with metres. "
                "For metres: camera_height_m in camera.yaml, a GPS track or scale.mode=known."
            ]
        if self.scale.mode == "none" and self.unit == NO_UNIT:
            seen, frames = known(self.scale.frames_used), known(self.sequence.frames)
            return [
                f"No metric unit: {seen} of {frames} frames see a road. Only "
                "the alignments with scale (scale, 7 dof) compare with metres. For metres, give the distance of two "
                "frames: --set scale.mode=known --set scale.known_between=[0,50] --set scale.known_m=1.5."
            ]
        if self.is_metric:
            return []
        why = self.scale.value.reason if isinstance(self.scale.value, Missing) else MISSING.reason
        return [f"No scale was found ({why}): lengths are in {self.unit}, not in metres."]
