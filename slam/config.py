"""The configuration of a SLAM run: frozen, complete, refusing what it does not know.

Every component gets its own section and never the whole tree. A YAML file may leave keys out (the
defaults hold); ``configs/slam/default.yaml`` writes all of them.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, Self

import yaml
from pydantic import BaseModel, ConfigDict, Field, PositiveInt, ValidationError, model_validator

from slam.config_file import override, read_tree
from slam.errors import ConfigError

ScaleMode = Literal["none", "camera-height", "lidar", "reference"]


class Section(BaseModel):
    """A frozen group of settings that refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class FrontendConfig(Section):
    """Noise of the pose network's direct snippet poses, see ``frontend/network_factors.py``."""

    use: Literal["calibrated", "gaps", "always"] = Field(
        default="calibrated",
        description="calibrated: always with a noise beside the weights, else gaps: where geometry has none",
    )
    rotation_sigma_deg: float = Field(default=0.3, gt=0, le=90, description="rotation sigma of a one-frame step")
    translation_relative_sigma: float = Field(default=0.1, gt=0, le=10, description="share of the step's length")
    translation_floor_ratio: float = Field(
        default=0.05, gt=0, le=10, description="floor, as a share of the median one-frame step"
    )
    noise_steps: int = Field(
        default=20, ge=1, description="steps that image geometry must share before the noise is measured on them"
    )
    student_t_dof: float = Field(default=12.0, gt=2, description="of freedom of Student's t by which pairs then err")


class GeometryConfig(Section):
    """Relative poses from tracked corners, see ``frontend/visual/odometry.py``."""

    enabled: bool = Field(default=True, description="add geometric factors beside the network's")
    steps: tuple[PositiveInt, ...] = Field(default=(1,), min_length=1, description="frame distances to measure")
    max_corners: int = Field(default=800, ge=50, le=10000, description="corners to track")
    corner_quality: float = Field(default=0.003, gt=0, lt=1, description="share of the best corner's strength")
    corner_spacing_px: float = Field(default=11.0, ge=1, description="least distance between corners")
    window_px: int = Field(default=11, ge=5, le=63, description="side of the tracking window")
    wide_window_px: int = Field(default=31, ge=5, le=63, description="its side where few corners could be followed")
    few_corners: int = Field(default=60, ge=0, description="fewer are few: they are sought again, exposure made alike")
    pyramid_levels: int = Field(default=4, ge=0, le=8, description="levels above the full image")
    predicted_flow: bool = Field(
        default=True, description="follow corners also through the view that learned depth and the last motion foretell"
    )
    rotation_baseline_steps: int = Field(
        default=2, ge=1, le=3, description="turns are also measured across so many steps at once; 1: they are not"
    )
    dynamic_mask_sharpness: float = Field(
        default=4.0, ge=0, description="power of the share of corners that fit near one lately; 0: believe all alike"
    )
    forward_backward_px: float = Field(default=0.5, gt=0, description="largest forward-backward error")
    inlier_px: float = Field(default=0.6, gt=0, description="largest epipolar distance of an inlier")
    reprojection_px: float = Field(default=2.0, gt=0, description="largest reprojection error of a PnP inlier")
    along_px: float = Field(default=0.4, gt=0, description="noise of a corner along its line, beside learned depth's")
    early_exit_inlier_ratio: float = Field(default=0.75, ge=0, le=1, description="inlier ratio that ends the search")
    depth_relative_sigma: float = Field(default=0.2, gt=0, description="least error of learned depth along a line")
    direction_prior_sigma_deg: float = Field(default=8.0, gt=0, description="least sigma of the motion prior")
    heading_prior_sigma_deg: float = Field(default=0.35, gt=0, description="least sigma of the heading prior")
    min_inliers: int = Field(default=20, ge=8, description="fewer refuse the measurement")
    still_flow_px: float = Field(default=0.3, ge=0, description="a median flow below means standing still")
    min_parallax_px: float = Field(
        default=0.8, gt=0, description="median motion that a rotation must leave unexplained"
    )
    min_point_parallax_px: float = Field(default=2.0, gt=0, description="least parallax of a point measuring length")
    max_depth_heights: float = Field(default=30.0, gt=0, description="farthest trusted depth, in camera heights")
    rotation_floor_deg: float = Field(
        default=0.002, gt=0, description="least rotation sigma of a motion by all corners"
    )
    direction_floor_deg: float = Field(default=0.045, gt=0, description="least sigma of the translation's direction")
    jitter_rotation_ratio: float = Field(default=0.33, ge=0, description="rotation sigma, share of the camera's shake")
    jitter_direction_ratio: float = Field(default=8.5, ge=0, description="sigma of the direction, likewise")
    turn_rotation_ratio: float = Field(default=0.015, ge=0, description="rotation sigma, share of the step's turn")
    neighbour_rotation_ratio: float = Field(
        default=0.25, ge=0, description="rotation sigma, share of the jump to neighbours"
    )
    neighbour_direction_ratio: float = Field(default=1.0, ge=0, description="sigma of the direction, likewise")
    student_t_dof: float = Field(default=12.0, gt=2, description="of freedom of Student's t by which a step errs")


class RoadConfig(Section):
    """Lengths of steps from the road's motion in the image, see ``frontend/scale/road_homography.py``."""

    enabled: bool = Field(default=True, description="measure steps on the road, in camera heights")
    far_heights: float = Field(default=9.0, gt=0, description="farthest road used, in camera heights")
    half_width_heights: float = Field(default=1.0, gt=0, description="half the width of the strip, likewise")
    near_heights: float = Field(default=4.5, gt=0, description="farthest road of the short strip behind a car ahead")
    near_half_width_heights: float = Field(default=2.0, gt=0, description="half the width of the short strip")
    near_relative_sigma: float = Field(default=0.1, gt=0, description="least relative sigma of a length by it")
    points: int = Field(default=4000, ge=100, description="about how many pixels to align")
    min_points: int = Field(default=300, ge=50, description="fewer refuse the measurement")
    tilt_sigma_deg: float = Field(default=0.1, gt=0, description="tilt to expect against the direction of motion")
    max_tilt_deg: float = Field(default=4.0, gt=0, lt=90, description="a plane tilted by more is not the road")
    min_correlation: float = Field(default=0.3, ge=0, le=1, description="a lower correlation refuses the step")
    min_gain: float = Field(default=0.25, ge=0, le=1, description="least share of an unmoved image's error explained")
    relative_sigma: float = Field(default=0.06, gt=0, description="least relative sigma of a length")
    tilt_gain: float = Field(default=2.0, ge=0, description="relative sigma for a radian of unexpected tilt")


class LengthConfig(Section):
    """Lengths of all steps at once, see ``frontend/scale/step_lengths.py``; sigmas of logarithms."""

    ratio_sigma: float = Field(default=0.004, gt=0, description="least sigma of a step over the one before")
    ratio_widening: float = Field(default=1.5, gt=0, description="sigmas that points give, widened by this")
    learned_sigma: float = Field(default=0.1, gt=0, description="of a length by learned depth")
    unit_walk_sigma: float = Field(default=0.003, gt=0, description="how far learned depth's unit walks in a step")
    unit_sigma: float = Field(default=0.2, gt=0, description="of that unit as the learned road gives it")
    max_contradiction: float = Field(default=2.5, gt=1, description="largest factor from the length by learned depth")
    outlier_sigmas: float = Field(default=2.0, gt=0, description="residual where a measurement has half its weight")
    correlated_widening: float = Field(
        default=1.5, gt=0, description="sigmas along the graph, widened by this: what ails a stretch of road lasts"
    )


class GapsConfig(Section):
    """Frames that show nothing usable, see ``frontend/image_gate.py`` and ``frontend/gap_interpolation.py``."""

    enabled: bool = Field(default=True, description="bridge unusable frames; else they are measured and may end a run")
    blank_contrast: float = Field(default=3.0, ge=0, description="a standard deviation of grey levels below is blank")
    noise_contrast: float = Field(default=0.3, ge=0, lt=1, description="share of contrast that survives blurring")
    min_correlation: float = Field(default=0.2, ge=-1, le=1, description="correlation with the frames before")
    repeat_difference: float = Field(
        default=0.1, ge=0, description="difference over gradient of an image encoded again"
    )
    max_unread_frames: int = Field(default=30, ge=1, description="more unreadable images in a row end the run")
    rotation_sigma_deg: float = Field(default=2.0, gt=0, le=90, description="rotation sigma of a bridged step")
    translation_relative_sigma: float = Field(default=0.5, gt=0, le=10, description="share of a bridged step's length")


class LidarConfig(Section):
    """What a LiDAR on the same car may do besides being compared with, see ``frontend/lidar_odometry.py``."""

    factors: bool = Field(default=False, description="add kiss-icp's steps to the graph; scale.mode=lidar fits them")
    rotation_sigma_deg: float = Field(default=0.1, gt=0, description="rotation sigma of a step")
    translation_sigma_m: float = Field(default=0.03, gt=0, description="translation sigma of a step")


class ScaleConfig(Section):
    """Metric scale, see ``frontend/scale/road_plane.py``."""

    mode: Literal["auto"] | ScaleMode = Field(
        default="auto", description="auto: camera-height where a height is known, else none"
    )
    reference_frames: int = Field(default=50, ge=2, description="first frames that mode reference compares")
    min_frames: int = Field(default=5, ge=1, description="fewer usable frames refuse a scale")
    rejection_mads: float = Field(default=3.0, gt=0, description="frames farther from the median are left out")
    smoothing_frames: int = Field(default=41, ge=1, description="window in which the scale may differ from the drive's")
    road_top_ratio: float = Field(
        default=0.35,
        ge=0,
        lt=1,
        description="top edge of the road trapezoid, from horizon (0) to image bottom (1)",
    )
    road_bottom_ratio: float = Field(default=0.97, gt=0, le=1, description="bottom edge, likewise")
    road_top_width: float = Field(default=0.16, gt=0, le=1, description="width of the top edge, share of the image")
    road_bottom_width: float = Field(default=0.5, gt=0, le=1, description="width of the bottom edge, likewise")
    max_tilt_deg: float = Field(default=12.0, gt=0, lt=90, description="plane normal from the camera's y axis")
    inlier_relative_depth: float = Field(default=0.05, gt=0, lt=1, description="depth error of a plane inlier")
    min_inlier_ratio: float = Field(default=0.5, gt=0, le=1, description="fewer inliers refuse the frame")

    @model_validator(mode="after")
    def _top_above_bottom(self) -> Self:
        if self.road_top_ratio >= self.road_bottom_ratio:
            raise ValueError("a road trapezoid with road_top_ratio < road_bottom_ratio")
        return self


class LoopsConfig(Section):
    """Loop closure, see ``loops/closure.py``; metres, or camera heights under scale mode none."""

    enabled: bool = Field(default=True, description="look for places seen before")
    frame_stride: int = Field(default=2, ge=1, description="look at every n-th frame")
    max_features: int = Field(default=500, ge=50, le=5000, description="corners remembered of a frame")
    corner_contrast: int = Field(default=10, ge=1, le=100, description="least grey-level contrast of a corner")
    max_depth_heights: float = Field(default=30.0, gt=0, description="farthest trusted depth, in camera heights")
    words: int = Field(default=1000, ge=10, le=20000, description="binary words learned on the run")
    min_gap_frames: int = Field(default=30, ge=1, description="a loop links frames at least this far apart")
    min_path_m: float = Field(default=15.0, ge=0, description="and after driving at least this far")
    candidates_per_frame: int = Field(default=2, ge=1, le=20, description="places to verify for a frame")
    peak_frames: int = Field(default=10, ge=0, description="places are at least this many frames apart")
    min_score: float = Field(default=0.2, ge=0, description="likeness, as a share of that of neighbouring frames")
    ratio: float = Field(default=0.85, gt=0, le=1, description="nearest over second nearest descriptor distance")
    max_hamming: int = Field(default=64, ge=1, le=256, description="largest distance of matching descriptors, bits")
    ransac_iterations: int = Field(default=200, ge=10, description="samples of perspective-n-point")
    reprojection_px: float = Field(default=3.0, gt=0, description="largest reprojection error of an inlier")
    min_inliers: int = Field(default=20, ge=6, description="fewer refuse the loop")
    min_inlier_ratio: float = Field(default=0.4, gt=0, le=1, description="share of the matches with depth that agree")
    min_spread_ratio: float = Field(default=0.1, ge=0, lt=1, description="standard deviation of the inliers' columns")
    agreement_deg: float = Field(default=2.0, gt=0, description="largest difference of both directions' rotations")
    agreement_ratio: float = Field(default=0.1, gt=0, description="of their positions, as a share of the depth")
    corner_sigma_widening: float = Field(default=1.25, gt=0, description="corners' own sigmas are widened by this")
    rotation_floor_deg: float = Field(default=0.02, gt=0, description="least rotation sigma")
    translation_floor_ratio: float = Field(default=0.0003, gt=0, description="least translation sigma, share of depth")
    length_relative_sigma: float = Field(default=0.04, gt=0, description="translation sigma, share of the translation")
    max_drift_ratio: float = Field(default=0.3, gt=0, description="largest correction, as a share of the way between")
    support_frames: int = Field(default=20, ge=1, description="loops with ends this near must agree")
    min_support: int = Field(default=2, ge=0, description="images whose loops must agree with a loop")
    alone_inliers: int = Field(default=120, ge=6, description="a loop with this many inliers may stand alone")
    support_sigmas: float = Field(default=3.0, gt=0, description="sigmas that agreeing loops may differ by")
    support_drift_ratio: float = Field(default=0.1, ge=0, description="drift of the odometry between their ends")
    support_drift_deg: float = Field(default=0.1, ge=0, description="likewise, a frame")


class PoseGraphConfig(Section):
    """The pose graph, see ``pose_graph.py``."""

    kernel: Literal["none", "huber", "huber-cauchy"] = Field(
        default="huber", description="robust loss; huber-cauchy polishes the Huber result with Cauchy"
    )
    huber_k: float = Field(default=1.345, gt=0, description="whitened residual where Huber turns linear")
    cauchy_k: float = Field(default=3.0, gt=0, description="whitened residual where Cauchy has halved the weight")
    max_iterations: int = Field(default=100, ge=1, description="Levenberg-Marquardt iterations per stage")
    relative_tolerance: float = Field(default=1e-6, gt=0, lt=1, description="stop below this relative decrease")
    max_dropped_loops: int = Field(default=10, ge=0, description="loop edges to give up where the system is singular")
    max_loop_residual: float = Field(default=8.0, gt=0, description="whitened residual where a loop is given up")


class MappingConfig(Section):
    """TSDF fusion, see ``mapping.py``; metres, or camera heights under scale mode none."""

    enabled: bool = Field(default=True, description="fuse a map")
    frame_stride: int = Field(default=1, ge=1, description="offer every n-th frame to the map")
    keyframe_distance_m: float = Field(default=0.3, ge=0, description="fuse after moving this far")
    keyframe_rotation_deg: float = Field(default=3.0, ge=0, description="or after turning this far")
    width_px: int = Field(default=416, ge=32, description="depth maps are thinned to about this width")
    voxel_size_m: float = Field(default=0.2, gt=0, description="side of a voxel")
    truncation_voxels: float = Field(default=4.5, ge=1, description="truncation distance of the signed distance")
    depth_min_m: float = Field(default=1.0, ge=0, description="nearest depth fused")
    depth_max_m: float = Field(default=25.0, gt=0, description="farthest depth fused")
    max_depth_step: float = Field(default=0.12, gt=0, description="relative step between neighbours that marks an edge")
    consistency: float = Field(default=0.1, gt=0, description="relative depth difference to the previous view")
    min_weight: float = Field(default=3.0, ge=0, description="observations that a voxel needs to be extracted")
    min_component_triangles: int = Field(default=100, ge=0, description="smaller pieces of the mesh are removed")
    max_blocks: int = Field(default=12000, ge=16, description="fusion stops there (16^3 voxels, 80 KiB a block)")

    @model_validator(mode="after")
    def _near_before_far(self) -> Self:
        if self.depth_min_m >= self.depth_max_m:
            raise ValueError("a range with depth_min_m < depth_max_m")
        return self


class OutputConfig(Section):
    """What a run writes."""

    root: str = Field(default="results", min_length=1, description="parent folder of run folders")
    report: bool = Field(default=True, description="write report.html")
    keep: Literal["nothing", "drive", "keyframes"] = Field(
        default="drive",
        description="for run --continue: nothing, what was measured, or that and frames for the map",
    )


class SlamConfig(Section):
    """Everything that a run can be told."""

    frontend: FrontendConfig = FrontendConfig()
    geometry: GeometryConfig = GeometryConfig()
    gaps: GapsConfig = GapsConfig()
    road: RoadConfig = RoadConfig()
    lengths: LengthConfig = LengthConfig()
    lidar: LidarConfig = LidarConfig()
    scale: ScaleConfig = ScaleConfig()
    loops: LoopsConfig = LoopsConfig()
    pose_graph: PoseGraphConfig = PoseGraphConfig()
    mapping: MappingConfig = MappingConfig()
    output: OutputConfig = OutputConfig()


def load_config(file_or_name: str | Path | None = None, overrides: Sequence[str] = ()) -> SlamConfig:
    """Read a configuration and change some of its keys.

    Args:
        file_or_name: a YAML file, or the name of one under ``configs/slam``; None for the defaults.
        overrides: ``section.key=value`` each, the value in YAML.

    Raises:
        ConfigError: one line that names the key or file, what came and what is allowed.
    """
    tree = {} if file_or_name is None else read_tree(file_or_name)
    for text in overrides:
        override(tree, text)
    try:
        return SlamConfig.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(_one_line(error)) from error


def dump_yaml(config: SlamConfig) -> str:
    """The whole configuration as YAML, every key with its meaning as a comment."""
    lines: list[str] = []
    for name, section in config:
        lines += [*([""] if lines else []), f"{name}:  # {_summary(section)}"]
        for key, value in section.model_dump(mode="json").items():
            text = yaml.safe_dump(value, default_flow_style=True, width=10_000).removesuffix("...\n").strip()
            lines.append(f"  {key}: {text}  # {type(section).model_fields[key].description}")
    return "\n".join(lines) + "\n"


def _one_line(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    # pydantic appends the branch of a union to the place; keys end where no such key is known
    known = list(_known_keys())
    place = [str(part) for part in first["loc"]]
    if first["type"] == "extra_forbidden":
        return _unknown_key(".".join(place), known)
    key = ".".join(place)
    while key and key not in known:
        key = key.rpartition(".")[0]
    if first["type"] == "model_type":
        return f"'{key}' is a section of keys; got {first['input']!r}"
    if key == "scale.mode":
        return f"'{key}' is one of auto, none, camera-height, lidar, reference; got {first['input']!r}"
    wanted = first["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return f"'{key}' should be {wanted}; got {first['input']!r}"


def _unknown_key(key: str, known: list[str]) -> str:
    nearest = difflib.get_close_matches(key, [name for name in known if name.count(".") == key.count(".")], 1)
    if not nearest:
        by_last_part = {name.rpartition(".")[2]: name for name in reversed(known)}
        last = difflib.get_close_matches(key.rpartition(".")[2], by_last_part, 1)
        nearest = [by_last_part[last[0]]] if last else []
    if nearest:
        return f"unknown key '{key}'; did you mean '{nearest[0]}'?"
    section = key.rpartition(".")[0]
    allowed = [name.rpartition(".")[2] for name in known if name.rpartition(".")[0] == section]
    return f"unknown key '{key}'; allowed{f' in {section}' if section else ''}: {', '.join(allowed)}"


def _known_keys() -> Iterator[str]:
    for name, section in SlamConfig():
        yield name
        yield from (f"{name}.{key}" for key in type(section).model_fields)


def _summary(section: Section) -> str:
    return (type(section).__doc__ or "").partition("\n")[0].rstrip(".").replace("``", "")
