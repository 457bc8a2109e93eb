"""Data types shared by the parts of the system: frozen records, two protocols, depth and slopes of images.

The front end, the graph and the map never import each other; ``slam/pipeline/run.py`` passes these between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.readers.camera_file import Pinhole
from slam.geometry.se3 import BoolArray, FloatArray, in_unit, invert

T = TypeVar("T")
_Kind = TypeVar("_Kind", bound=np.generic)
Image = NDArray[np.uint8]
Grey = NDArray[np.uint8]
Float32Array = NDArray[np.float32]
DepthMap = Float32Array
Mask = NDArray[np.bool_]
Descriptors = NDArray[np.uint8]
Event = Literal["map begun", "lost", "relocalised", "map joined"]  # of the tracking of keyframes
Ends = tuple[int, int]  # the two frames of a step or a factor
LOOP_SOURCE = "loop"  # the ``source`` of relative poses that close a loop: the graph may drop these
KEYFRAME_SOURCE = "window"  # in metrics.json
_TRUSTED_HEIGHTS = 30.0  # largest learned depth that is used, in camera heights
_SURFACE_STEP = 0.12  # relative depth step between neighbouring pixels of one surface
# of two pixels equally near that right and below, on a road the nearer one
_TIE_PX = np.float32(1e-3)


@dataclass(frozen=True)
class Intrinsics(Pinhole):
    """A pinhole camera without distortion; (0, 0) is the centre of the top-left pixel.

    ``undistorted`` is True where the camera itself has a lens with distortion, and its images are undistorted as they
    are read; ``focal_sigma`` is relative, of the focal length, 0 where it was calibrated. ``readout_s`` is the time
    from the first row to the last of a rolling shutter.
    """

    undistorted: bool = field(default=False, kw_only=True, compare=False, repr=False)
    focal_sigma: float = field(default=0.0, kw_only=True, compare=False, repr=False)
    readout_s: float = field(default=0.0, kw_only=True, repr=False)

    @property
    def K(self) -> FloatArray:
        """The camera matrix ``(3, 3)``, pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def focal_half_widths(self) -> float:
        """The focal length over half the width of the image."""
        return 2.0 * self.fx / self.width

    def rays(self, pixels: NDArray[Any]) -> FloatArray:
        """Rays ``(..., 3)`` with z = 1 through pixels ``(..., 2)``."""
        u, v = np.moveaxis(np.asarray(pixels), -1, 0)
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def project(self, points_camera: FloatArray) -> FloatArray:
        """Pixels ``(..., 2)`` of points ``(..., 3)``, NaN for those behind the camera."""
        x, y, z = np.moveaxis(points_camera, -1, 0)
        z = np.where(z > 0, z, np.nan)
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)

    def pixel_grid(self) -> FloatArray:
        """Every pixel ``(H, W, 2)`` as (u, v)."""
        v, u = np.mgrid[: self.height, : self.width]
        return np.stack([u, v], axis=-1).astype(np.float64)


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a sequence: ``image`` ``(H, W, 3)`` uint8 RGB, ``stamp`` in seconds.

    ``fixed`` ``(h, w)``, of any size, is True where the image shows what is fixed to the camera, as the
    bonnet; None where all of it shows the world. Values that depend on the image alone (grey levels, the
    networks' input) are computed once and kept.
    """

    index: int
    stamp: float
    image: Image
    fixed: Mask | None = None
    _derived: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False)

    def derived(self, key: Hashable, make: Callable[[], T]) -> T:
        """The result of ``make``, computed at the first call with this key; thread-safe."""
        if key not in self._derived:
            self._derived.setdefault(key, make())
        known: T = self._derived[key]
        return known

    def is_fixed(self, pixels: FloatArray | Float32Array) -> BoolArray:
        """Which pixels ``(M, 2)`` show what is fixed to the camera ``(M,)``."""
        if self.fixed is None:
            return np.zeros(len(pixels), np.bool_)
        return nearest(resized_mask(self.fixed, *self.image.shape[1::-1]), pixels)

    def resized(self, width: int, height: int) -> Frame:
        """The same in another size, smaller or its own."""
        size = width, height

        def resized() -> Frame:
            image = cv2.resize(self.image, size, interpolation=cv2.INTER_AREA)
            return replace(self, image=np.asarray(image, np.uint8))

        is_own = self.image.shape[1::-1] == size
        return self if is_own else self.derived(("resized", size), resized)

    @property
    def grey(self) -> Grey:
        """Grey levels ``(H, W)`` uint8."""
        return self.derived(
            "grey", lambda: np.asarray(cv2.cvtColor(self.image, cv2.COLOR_RGB2GRAY), np.uint8)
        )


class Sequence(Protocol):
    """A recording: frames in time order, their camera, and optional calibration and ground truth.

    ``reference`` is the true ``T_world_camera`` ``(N, 4, 4)`` with the first pose the identity, or
    None; ``camera_height_m`` is the height of the camera above the road, ``T_camera_lidar`` takes LiDAR
    points to the camera: each None where unknown.
    """

    name: str
    intrinsics: Intrinsics
    stamps: FloatArray
    reference: FloatArray | None
    camera_height_m: float | None
    T_camera_lidar: FloatArray | None

    def __len__(self) -> int:
        """Number of frames."""

    def frame(self, index: int) -> Frame:
        """Read one frame.

        Args:
            index: of the frame, from 0.

        Raises:
            MissingFrameError: its number is missing from the files, a gap in time; a
                `SequenceError`.
            SequenceError: there is no such frame, or its image cannot be read.
        """

    def has_scan(self, index: int) -> bool:
        """Whether a LiDAR scan was taken with a frame.

        Args:
            index: of the frame, from 0.
        """

    def scan(self, index: int) -> FloatArray:
        """The points ``(P, 3)`` of a frame's scan, metres, in the LiDAR.

        Args:
            index: of a frame that has a scan.

        Raises:
            SequenceError: the frame has no scan, or it cannot be read.
        """

    def provenance(self) -> tuple[str, ...]:
        """Names of the recordings, as in the leak record of a checkpoint."""


@dataclass(frozen=True)
class SnippetPoses:
    """Output of the pose network for one snippet.

    ``T_source_target`` ``(N, 4, 4)``: target camera to source camera, unscaled, row k for
    ``sources[k]`` in time order; ``target`` is the middle frame.
    """

    target: int
    sources: tuple[int, ...]
    T_source_target: FloatArray

    @property
    def T_target_camera(self) -> dict[int, FloatArray]:
        """Poses ``(4, 4)`` of the snippet's cameras in that of the target, by frame, the target among them."""
        T_target_source = invert(self.T_source_target)
        return {**dict(zip(self.sources, T_target_source, strict=True)), self.target: np.eye(4)}


class Predictor(Protocol):
    """Depth and snippet poses, each in an unknown scale: networks, depth from elsewhere, or an oracle."""

    sources: int

    def depth(self, frame: Frame) -> DepthMap:
        """Unscaled z-depth ``(H, W)`` of a frame, at the image's size: positive and finite, or NaN where unknown.

        Args:
            frame: its image is ``(H, W, 3)``.

        Raises:
            SlamError: depth from elsewhere has no file for this frame, or its network fails.
        """

    def snippet(self, frames: list[Frame]) -> SnippetPoses:
        """Poses of the sources of a snippet whose target is the middle frame.

        Args:
            frames: of one snippet in time order, as many as ``sources`` and the target.

        Raises:
            SlamError: depth from elsewhere is known in none of the frames, where poses take their
                unit from it.
        """

    def executor(self) -> Executor:
        """A new executor of one thread for this predictor, with its number of cores; the user shuts it down."""


@dataclass(frozen=True)
class View:
    """The features of one frame, about 60 bytes each.

    ``pixels`` ``(M, 2)`` float32, ``descriptors`` ``(M, 32)`` uint8, ``points`` ``(M, 3)`` float32 in the camera,
    NaN where the learned depth is not trusted, in the unit of the depth.
    """

    index: int
    pixels: Float32Array
    descriptors: Descriptors
    points: Float32Array

    def __len__(self) -> int:
        return len(self.pixels)

    def scaled(self, factor: float | FloatArray) -> View:
        """The same view with the points along their rays by a factor, one for all or one each ``(M,)``."""
        return replace(self, points=self.points * np.asarray(factor, np.float32)[..., None])


@dataclass(frozen=True)
class RelativePose:
    """A measured ``T_from_to`` between two frames and its noise.

    ``sigmas`` ``(6,)``: standard deviations in GTSAM's tangent order, rotation (radians) first, then
    translation in the units of the measurement. ``source`` names the method. Errors of
    neighbours may be correlated and add up along a chain faster than independent ones: ``correlated_sigmas`` ``(6,)``
    are the larger sigmas of independent errors that add up as fast.
    Errors follow Student's t with ``student_t_dof`` degrees of freedom; they are normal where that is infinite.
    """

    from_index: int
    to_index: int
    T_from_to: FloatArray
    sigmas: FloatArray
    source: str
    correlated_sigmas: FloatArray | None = None
    student_t_dof: float = math.inf

    @property
    def ends(self) -> Ends:
        """Both frames."""
        return self.from_index, self.to_index

    def scaled(self, scale: float) -> RelativePose:
        """The same measurement in another unit: translation and its sigmas times ``scale``."""
        units = np.repeat([1.0, scale], 3)
        correlated = None if self.correlated_sigmas is None else self.correlated_sigmas * units
        T_from_to, sigmas = in_unit(self.T_from_to, scale), self.sigmas * units
        return replace(self, T_from_to=T_from_to, sigmas=sigmas, correlated_sigmas=correlated)

    @property
    def graph_sigmas(self) -> FloatArray:
        """Sigmas ``(6,)`` for a graph, which assumes independent errors of its factors."""
        return self.sigmas if self.correlated_sigmas is None else self.correlated_sigmas


@dataclass(frozen=True)
class TrackingEvent:
    """An event in the tracking of keyframes at a frame.

    A map began, the camera was lost from this frame on, it was found again at the place of an ``other`` frame, or the
    map that begins here was joined with that of an ``other`` frame. ``support`` is the number of points, or of loops.
    """

    frame: int
    event: Event
    other: int | None = None
    support: int | None = None

    def __str__(self) -> str:
        """For logs and reports."""
        at = "" if self.other is None else f" at the place of frame {self.other}"
        what = "loops" if self.event == "map joined" else "points"
        by = "" if self.support is None else f", by {self.support} {what}"
        return f"frame {self.frame}: {self.event}{at}{by}"


@dataclass(frozen=True)
class GpsTrack:
    """Fixes of a GPS receiver.

    Attributes:
        stamps: seconds ``(M,)``, increasing.
        places: latitude and longitude in degrees, height over the ellipsoid or the sea in metres, ``(M, 3)``;
            heights are NaN where the receiver gives none.
        dilution: of precision, factors on the usual sigmas of a fix ``(M,)``.
        speeds: metres a second ``(M,)``, NaN where unknown.
    """

    stamps: FloatArray
    places: FloatArray
    dilution: FloatArray
    speeds: FloatArray


def nearest(values: NDArray[_Kind], pixels: FloatArray | Float32Array) -> NDArray[_Kind]:
    """Values ``(M,)`` of a map ``(H, W)`` at the pixels nearest to points ``(M, 2)``."""
    u, v = np.clip(np.rint(pixels).astype(np.int64), 0, np.array(values.shape[::-1]) - 1).T
    found: NDArray[_Kind] = values[v, u]
    return found


def nearest_depth(depth: DepthMap, pixels: FloatArray | Float32Array) -> FloatArray:
    """Depth ``(M,)`` of a map ``(H, W)`` at the pixels nearest to points ``(M, 2)``, NaN where it is unknown."""
    found = nearest(depth, pixels).astype(np.float64)
    return np.where(np.isfinite(found) & (found > 0), found, np.nan)


def trusted_depth(depth: FloatArray, height: float | None) -> FloatArray:
    """Learned depth with NaN where it lies beyond 30 camera heights; ``height`` has the same unit, None is unknown."""
    return depth if height is None else np.where(depth < _TRUSTED_HEIGHTS * height, depth, np.nan)


def sampled_depth(depth: DepthMap, u: Float32Array, v: Float32Array) -> DepthMap:
    """Depth of a map ``(H, W)``, not positive or not finite where unknown, at columns and rows ``(h, w)``.

    Linear in 1/depth, which is exact on planes, where the four pixels around are known and of one surface; elsewhere
    that of the nearest pixel, so that edges are not smeared and unknown depth does not spread.
    """
    known = np.isfinite(depth) & (depth > 0)
    inverse = np.zeros(depth.shape, np.float32)
    np.divide(1, depth, out=inverse, where=known)
    pixels = np.ones((2, 2), np.uint8)  # this one, and those right and below
    column, row = np.floor(u), np.floor(v)
    least, most = (
        _nearest(bound(inverse, pixels, anchor=(0, 0)), column, row)
        for bound in (cv2.erode, cv2.dilate)
    )
    between = cv2.remap(inverse, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    sampled = _nearest(depth, u + _TIE_PX, v + _TIE_PX)
    is_one_surface = (least > 0) & (most <= (1 + _SURFACE_STEP) * least)
    np.divide(1, between, out=sampled, where=is_one_surface)
    return sampled


def resized_depth(depth: DepthMap, width: int, height: int) -> DepthMap:
    """The depth map ``(height, width)`` of an image resized to so many pixels, as `sampled_depth`."""
    if depth.shape == (height, width):
        return depth
    u, v = (
        ((np.arange(to, dtype=np.float32) + 0.5) * (of / to) - 0.5).astype(np.float32)
        for to, of in ((width, depth.shape[1]), (height, depth.shape[0]))
    )
    return sampled_depth(depth, *np.meshgrid(u, v))


def resized_mask(mask: Mask, width: int, height: int) -> Mask:
    """The mask ``(height, width)`` of an image resized to so many pixels."""
    resized = cv2.resize(mask.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(resized, bool)


def shrunk(grey: Grey, ratio: int) -> Float32Array:
    """Grey levels ``(h, w)`` of an image of ``ratio`` times this size.

    Without the last rows and columns that fill no pixel: whole pixels are averaged ten times as fast.
    """
    height, width = (max(side // ratio, 1) for side in grey.shape)
    whole = grey[: ratio * height, : ratio * width]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def slopes_of(image: Float32Array) -> list[Float32Array]:
    """Derivatives of an image ``(H, W)`` along its rows and columns, grey levels a pixel."""
    return [
        np.asarray(cv2.Sobel(image, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8)) for dx in (1, 0)
    ]


def _nearest(values: Float32Array, u: Float32Array, v: Float32Array) -> Float32Array:
    return cv2.remap(values, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
