"""The configuration of a SLAM run: one frozen section for each component.

A YAML file may leave keys out, which then have their defaults; ``configs/slam/default.yaml`` lists all of them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, PositiveFloat, PositiveInt, field_validator, model_validator

import erfsfm.common.errors
from erfsfm.common.config_tree import Section, dump_explained
from erfsfm.common.config_tree import load_config as load_tree
from slam.runtime.errors import ConfigError
from slam.runtime.imports import plug_ins

_HERE = Path(__file__).resolve().parents[1]
# in the source tree, in the wheel
_SHIPPED = (_HERE.parent / "configs" / "slam", _HERE / "_configs")
dump_yaml = dump_explained  # with the description of every key
DEPTH_SOURCES = ("onnx", "npy", "png")
DEPTH_PLUG_INS = "erfsfm_slam.depth"  # entry points of other packages: see docs/depth.md

ScaleMode = Literal["none", "camera-height", "lidar", "reference", "known", "gps"]


class DepthConfig(Section):
    """The source of depth and the refinement of the keyframes' depth, see ``docs/depth.md``."""

    source: str = Field(
        default="network",
        description="network, onnx:FILE, or npy:FOLDER or png:FOLDER with one file a frame",
    )
    frame_stride: int = Field(
        default=2,
        ge=1,
        description="networks predict depth at every n-th frame and where the camera has moved on; it is carried to "
        "those between, and snippets touch. With 1, and from files, every frame has its own",
    )
    kind: Literal["auto", "depth", "disparity"] = Field(
        default="auto",
        description="content of the source; auto: depth in folders, disparity in ONNX files of erfsfm export",
    )
    align: Literal["none", "scale", "affine"] = Field(
        default="none",
        description="none: all frames have one unit; scale: each has its own; affine: also its own shift of disparity",
    )
    mean: tuple[float, float, float] | None = Field(
        default=None,
        description="onnx: mean of RGB in [0, 1], which is subtracted; null for ONNX files of erfsfm export",
    )
    std: tuple[PositiveFloat, PositiveFloat, PositiveFloat] | None = Field(
        default=None,
        description="onnx: standard deviation, by which RGB less the mean is divided; null likewise",
    )
    size: tuple[PositiveInt, PositiveInt] | None = Field(
        default=None, description="onnx: height and width of the input; null if the file fixes them"
    )
    output_name: str = Field(
        default="", description="onnx: name of the output, if the network has several"
    )
    png_scale: float = Field(
        default=256.0,
        gt=0,
        description="png: value of a pixel at a depth of 1 m; a pixel of 0 is unknown",
    )
    refine: Literal["none", "learned"] = Field(
        default="learned",
        description="the keyframes' depth by neighbouring images at the optimised poses; learned: a network fuses both",
    )
    fusion: str = Field(
        default="default",
        description="learned: default, or an output folder of erfsfm train-fusion",
    )

    @property
    def is_learned(self) -> bool:
        """Whether a network gives the depth, not files."""
        return not self.source.startswith(("npy:", "png:"))

    @property
    def predicted_stride(self) -> int:
        """Frames between those whose depth is asked for: files have one for each."""
        return self.frame_stride if self.is_learned else 1

    @field_validator("source")
    @classmethod
    def _known_source(cls, source: str) -> str:
        kind, colon, path = source.partition(":")
        if source == "network" or (kind in DEPTH_SOURCES and colon and path):
            return source
        others = plug_ins(DEPTH_PLUG_INS)
        if not (kind in others and colon and path):
            raise ValueError(
                ", ".join(
                    ("network, onnx:FILE, npy:FOLDER or png:FOLDER", *(f"{n}:..." for n in others))
                )
            )
        return source


class VisualOdometryConfig(Section):
    """Relative poses from tracked corners, see ``frontend/visual/odometry.py``."""

    enabled: bool = Field(default=True, description="measure relative poses by image geometry")


class KeyframesConfig(Section):
    """Keyframes with bundle adjustment, see ``frontend/keyframes/odometry.py``."""

    use: Literal["auto", "always", "never"] = Field(
        default="auto",
        description="auto: unless a camera height is known or the first steps are a vehicle's; never: steps only",
    )


class GapsConfig(Section):
    """Gap interpolation over unusable frames, see ``frontend/gaps.py`` and ``frontend/image_gate.py``."""

    enabled: bool = Field(
        default=True,
        description="interpolate over unusable frames; false: measure them like other frames, which may end the run",
    )


class LidarConfig(Section):
    """LiDAR odometry, see ``frontend/lidar_odometry.py``. Without factors it is only compared."""

    factors: bool = Field(default=False, description="add kiss-icp's odometry to the pose graph")


class GpsConfig(Section):
    """A GPS track beside the images, see ``docs/gps.md``."""

    factors: bool = Field(
        default=True, description="add the positions to the pose graph; false: only compare them"
    )
    sigma_m: float = Field(
        default=2.5, gt=0, description="sigma of a fix east and north where its HDOP is 1, metres"
    )
    vertical_sigma_m: float = Field(
        default=5.0, gt=0, description="sigma of the height of a fix, metres"
    )
    correlation_s: float = Field(
        default=10.0, ge=0, description="time for which fixes share their error, seconds"
    )
    offset_s: float = Field(default=0.0, description="added to the stamps of the fixes, seconds")


class ScaleConfig(Section):
    """Metric scale, see ``frontend/scale_mode.py``."""

    mode: Literal["auto", ScaleMode] = Field(
        default="auto",
        description="auto: camera-height where a height is known, else gps with --gps, else none",
    )
    known_m: float | None = Field(
        default=None, gt=0, description="mode known: distance of the two frames, metres"
    )
    known_between: tuple[int | str, int | str] | None = Field(
        default=None,
        description="mode known: two frames of the run, or stamps in seconds such as 12.5s",
    )

    @field_validator("known_between")
    @classmethod
    def _frames_or_stamps(
        cls, ends: tuple[int | str, int | str] | None
    ) -> tuple[int | str, int | str] | None:
        for end in ends or ():
            if (end < 0) if isinstance(end, int) else not re.fullmatch(r"-?\d+(\.\d*)?s", end):
                raise ValueError("two frame numbers, or stamps in seconds such as 12.5s")
        return ends

    @model_validator(mode="after")
    def _known_is_given(self) -> Self:
        if self.mode == "known" and (self.known_m is None or self.known_between is None):
            raise ValueError("known_m and known_between beside mode known")
        return self


class LoopsConfig(Section):
    """Loop closure, see ``loops/closure.py``."""

    enabled: bool = Field(default=True, description="detect and close loops")


class MappingConfig(Section):
    """The map, see ``docs/design/map.md``. Without metres, all lengths here follow the depth of the scene."""

    enabled: bool = Field(default=True, description="fuse depth maps into a mesh and a point cloud")
    keyframe_distance_m: float = Field(
        default=1.5, ge=0, description="distance between keyframes, metres"
    )
    voxel_size_m: float = Field(default=0.2, ge=1e-3, le=100, description="side of a voxel, metres")
    depth_min_m: float = Field(default=1.0, ge=0, description="smallest fused depth, metres")
    depth_max_m: float = Field(
        default=20.0,
        gt=0,
        description="largest fused depth, metres; up to 1.4 times that where it is certain",
    )
    close_holes_m: float = Field(
        default=1.5,
        ge=0,
        description="largest diameter of a hole of the road that is closed, metres",
    )
    memory_mb: int = Field(
        default=1000,
        ge=100,
        description="memory of the map, MiB; a submap ends before it takes more",
    )

    @property
    def reach_m(self) -> float:
        """Depth up to which anything is fused: where its sigma is small, beyond ``depth_max_m``."""
        return 1.4 * self.depth_max_m

    def in_unit(self, per_metre: float) -> MappingConfig:
        """The same lengths in a unit of which a metre has ``per_metre``."""
        lengths = {
            name: per_metre * getattr(self, name)
            for name in type(self).model_fields
            if name.endswith("_m")
        }
        return self.model_copy(update=lengths)

    @model_validator(mode="after")
    def _near_before_far(self) -> Self:
        if self.depth_min_m >= self.depth_max_m:
            raise ValueError("a range with depth_min_m < depth_max_m")
        return self


class OutputConfig(Section):
    """The output of a run."""

    root: str = Field(default="results", min_length=1, description="parent folder of run folders")
    report: bool = Field(default=True, description="write report.html")


class SlamConfig(Section):
    """All settings of a run."""

    depth: DepthConfig = DepthConfig()
    visual_odometry: VisualOdometryConfig = VisualOdometryConfig()
    keyframes: KeyframesConfig = KeyframesConfig()
    gaps: GapsConfig = GapsConfig()
    lidar: LidarConfig = LidarConfig()
    gps: GpsConfig = GpsConfig()
    scale: ScaleConfig = ScaleConfig()
    loops: LoopsConfig = LoopsConfig()
    mapping: MappingConfig = MappingConfig()
    output: OutputConfig = OutputConfig()


def load_config(
    file_or_name: str | Path | None = None, overrides: Sequence[str] = ()
) -> SlamConfig:
    """Read a configuration and change some of its keys.

    Args:
        file_or_name: a YAML file, or the name of one under ``configs/slam``; None for the defaults.
        overrides: ``section.key=value`` each, the value in YAML.

    Raises:
        ConfigError: one line that names the key or file, what came and what is allowed.
    """
    try:
        return load_tree(SlamConfig, file_or_name, overrides, _SHIPPED)
    except erfsfm.common.errors.ConfigError as error:
        raise ConfigError(str(error)) from error
