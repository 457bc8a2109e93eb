"""The road between two images: the length of a step in camera heights, by a homography.

A plane ``n . X = h`` of the current camera maps to the previous one by the homography
``R + t n^T / h`` (Hartley and Zisserman 2004, Eq. 13.2). Rotation and direction of ``t`` are known
from corners; the vector ``m = |t| n / h`` that aligns both images of the road is estimated; its
norm is the length. Learned depth is not used, so this length has neither the bias nor the drift of
the networks.

Brightness that changes slowly over the image (light, reflections) is removed from the difference of
the images. Taken from each image before, it would not be the same part of the road in both, for the
road is larger in the later one: lengths came out 1 % short.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import groupby

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Ends, Frame, Intrinsics, Mask, resized_mask, slopes_of
from slam.frontend.visual.motion import Steps, links, triangulated
from slam.geometry.robust import mad_sigma, median, running_median
from slam.geometry.se3 import (
    FloatArray,
    IntArray,
    chain,
    interpolated,
    invert,
    length_of,
    normalised,
    path_distance,
)
from slam.runtime.errors import Failed

_LEVEL = np.array([0.0, 1.0, 0.0])
# searched; refinement converges between them
_LENGTHS_HEIGHTS = np.geomspace(0.02, 2.5, 32, dtype=np.float32)
_CLIPPED_GREY = 8.0
_ITERATIONS = 6
_CONVERGED = 1e-3  # of the length, whose sigma is fifty times as large
_STEPS_KEPT = 100
# strips of ground, a long one and a short one before a vehicle: farthest ground and half width, in
# camera heights, and the relative sigma of independent errors that add up as those of neighbouring
# lengths do, which are correlated; single lengths err by a third to a half of it
_SHAPES = (9.0, 1.0, 0.06), (4.5, 2.0, 0.1)
_POINTS = 2500  # approximate number of aligned pixels
_MIN_POINTS = 300  # least number of aligned pixels of a measurement
# sigma of the ground plane's tilt against the direction of motion, degrees, beside pixels that count as
# independent, and the power of the hidden distance by which they count for more
_TILT_SIGMA_DEG, _TRUST = 0.07, 4
_MAX_TILT_DEG = 4.0  # largest tilt of the ground plane, degrees
_MIN_CORRELATION = 0.3  # least correlation of the aligned pixels
# least fraction of the photometric error without motion that the alignment removes
_MIN_GAIN = 0.25
_REACH_HEIGHTS = 2.5  # of the path before and after a frame, in camera heights: 4 m of a car
_USUAL_STEPS = 101  # whose median direction is the usual one
_PITCH_SIGMA_DEG = 0.3  # of a car against its usual pitch, degrees
_OF_PATH = 0.5  # noise of the path's direction over that of a single step

_Layer = NDArray[np.float32]


@dataclass(frozen=True)
class RoadStep:
    """What the images of the road say of the vector ``m`` ``(3,)`` of a step, whose norm is its length in heights.

    ``information`` ``(3, 3)`` and ``right`` ``(3,)`` are their normal equations, without what is
    expected of the road's normal; ``plane`` is their solution with it. ``relative_sigma`` is that
    of the length.
    """

    plane: FloatArray
    information: FloatArray
    right: FloatArray
    relative_sigma: float

    @property
    def length_heights(self) -> float:
        """Length of the step, in camera heights."""
        return length_of(self.plane)

    def along(self, direction: FloatArray) -> RoadStep:
        """The same where a car goes in a ``direction`` ``(3,)`` of the later camera, parallel to its road."""
        plane = _solved(self.information, self.right, _normal_along(direction), self.length_heights)
        return replace(self, plane=plane)


class RoadHomography:
    """Aligns the road between two frames of one sequence by its homography, and tracks the direction of motion.

    A car ahead occludes most of a long strip of road and stands still in the image. Where the long
    strip fails, a short and wide one is used, which ends before such a car; it is less accurate.
    """

    def __init__(self, intrinsics: Intrinsics) -> None:
        """Prepare for the first step."""
        self._intrinsics = intrinsics
        self._top_row = int(np.clip(np.floor(intrinsics.cy), 0, intrinsics.height - 1))
        self._fixed: Mask | None = None
        self._strips = self._visible(None)
        self._directions: tuple[FloatArray, ...] = ()  # of motion, of the last steps

    def measure(
        self, previous: Frame, current: Frame, T_previous_current: FloatArray
    ) -> RoadStep | Failed:
        """Measure the length of a step whose rotation and direction are known.

        Args:
            previous: the earlier frame, at the size of the intrinsics.
            current: the later frame.
            T_previous_current: its pose in the earlier camera, of any length but zero.
        """
        if current.fixed is not self._fixed:
            self._fixed, self._strips = current.fixed, self._visible(current.fixed)
        T_unit = T_previous_current.copy()
        T_unit[:3, 3] /= np.linalg.norm(T_unit[:3, 3])
        self._directions = (*self._directions, T_unit[:3, 3])[-_STEPS_KEPT:]
        # of a level camera, pitched so that the motion is parallel to the road: the images alone
        # tell pitch poorly
        expected = _normal_along(np.median(self._directions, axis=0))
        for strip in self._strips:
            measured = self._measured_on(strip, previous, current, T_unit, expected)
            if isinstance(measured, RoadStep):
                break
        return measured

    def _visible(self, fixed: Mask | None) -> list[_Strip]:
        camera = self._intrinsics
        hidden = np.zeros((1, 1), bool) if fixed is None else fixed
        visible = ~resized_mask(hidden, camera.width, camera.height)[self._top_row :]
        return [_strip(camera, self._top_row, *shape, visible) for shape in _SHAPES]

    def _measured_on(
        self,
        strip: _Strip,
        previous: Frame,
        current: Frame,
        T_unit: FloatArray,
        expected: FloatArray,
    ) -> RoadStep | Failed:
        if len(strip.rows) < _MIN_POINTS:
            return Failed("the image shows too little of the road")
        before, now = self._layers(previous), self._layers(current)
        plane = self._search(strip, before[0], now[0], T_unit, expected)
        try:
            for layer_before, layer_now in zip(before, now, strict=True):
                step, correlation = self._refine(
                    strip, layer_before, layer_now, T_unit, plane, expected
                )
                plane = step.plane
        except np.linalg.LinAlgError:
            return Failed("both images of the road are even")
        fine_before = strip.local(before[1][strip.rows, strip.columns, 0])
        fine_now = strip.local(now[1][strip.rows, strip.columns, 0])
        standing = _correlation(fine_before, fine_now)
        length = max(length_of(plane), 1e-9)
        deviation = float(np.arccos(np.clip(plane / length @ expected, -1.0, 1.0)))
        if not np.isfinite(length) or deviation > np.deg2rad(_MAX_TILT_DEG):
            return Failed(f"the road would be tilted by {np.rad2deg(deviation):.0f} deg")
        if correlation < _MIN_CORRELATION:
            return Failed(f"both images of the road do not correlate ({correlation:.2f})")
        if 1.0 - correlation > (1.0 - _MIN_GAIN) * (1.0 - standing):
            return Failed(
                f"the image in front of the car stands still (correlation {standing:.2f})"
            )
        return step

    def _layers(self, frame: Frame) -> list[_Layer]:
        """A coarse image ``(H', W, 3)`` below the horizon, high-pass filtered, and the image, both with gradients."""

        def filtered() -> list[_Layer]:
            grey = frame.grey[self._top_row :].astype(np.float32)
            # what changes slowly, by a blur that is computed in a smaller image where it is wide
            sigma_px = _gradual_px(self._intrinsics)
            ratio = max(int(sigma_px) // 2, 1)
            size = max(grey.shape[1] // ratio, 1), max(grey.shape[0] // ratio, 1)
            small = cv2.GaussianBlur(
                cv2.resize(grey, size, interpolation=cv2.INTER_AREA), (0, 0), sigma_px / ratio
            )
            local = grey - np.asarray(cv2.resize(small, grey.shape[::-1]), np.float32)
            coarse = cv2.GaussianBlur(local, (0, 0), max(0.004 * self._intrinsics.fx, 1.0))
            return [np.asarray(cv2.merge([layer, *slopes_of(layer)])) for layer in (coarse, grey)]

        return frame.derived(("road layers", self._top_row, self._intrinsics.fx), filtered)

    def _sampled(self, layer: _Layer, points_previous: _Layer) -> _Layer:
        """Grey levels and gradients ``(..., P, 3)`` of the earlier image at points ``(..., 3, P)`` of its camera."""
        camera = self._intrinsics
        x, y, z = np.moveaxis(points_previous, -2, 0)
        u = camera.fx * x / z + camera.cx
        v = camera.fy * y / z + camera.cy - self._top_row
        columns = np.asarray(u, np.float32).reshape(-1, u.shape[-1])
        rows = np.asarray(v, np.float32).reshape(-1, u.shape[-1])
        return np.asarray(cv2.remap(layer, columns, rows, cv2.INTER_LINEAR)).reshape(*u.shape, 3)

    def _search(
        self, strip: _Strip, before: _Layer, now: _Layer, T_unit: FloatArray, normal: FloatArray
    ) -> FloatArray:
        """The best of fixed lengths at the expected normal, on every third pixel of the coarse image."""
        rays, seen = strip.rays[:, ::3], now[strip.rows[::3], strip.columns[::3], 0]
        R, t, n = _single(T_unit[:3, :3], T_unit[:3, 3], normal)
        shift = np.outer(t, n @ rays)
        points = _ahead(R @ rays + _LENGTHS_HEIGHTS[:, None, None] * shift)
        difference = self._sampled(before, points)[..., 0] - seen
        costs = np.minimum(np.abs(difference), _CLIPPED_GREY).mean(axis=1)
        return _LENGTHS_HEIGHTS[int(np.argmin(costs))] * normal

    def _refine(
        self,
        strip: _Strip,
        before: _Layer,
        now: _Layer,
        T_unit: FloatArray,
        plane: FloatArray,
        expected: FloatArray,
    ) -> tuple[RoadStep, float]:
        """Gauss-Newton with Cauchy weights on the plane ``m`` ``(3,)``; also the correlation of both images."""
        fx, fy, (tx, ty, tz) = self._intrinsics.fx, self._intrinsics.fy, T_unit[:3, 3].tolist()
        R, t = _single(T_unit[:3, :3], T_unit[:3, 3])
        rotated, seen = R @ strip.rays, now[strip.rows, strip.columns, 0]
        for _ in range(_ITERATIONS):
            (m,) = _single(plane)
            points = _ahead(rotated + np.outer(t, m @ strip.rays))
            grey, slope_x, slope_y = np.ascontiguousarray(self._sampled(before, points).T)
            residual = strip.local(grey - seen)
            x, y, z = points
            slope = (slope_x * fx * (tx - x / z * tz) + slope_y * fy * (ty - y / z * tz)) / z
            sigma = max(mad_sigma(residual), 0.3)
            # farther ground tells the tilt better beside what is expected of it
            trust = strip.hidden**_TRUST / sigma**2
            weighted = strip.rays * (slope * trust / (1.0 + (residual / (2.0 * sigma)) ** 2))
            information = ((weighted * slope) @ strip.rays.T).astype(np.float64)
            right = information @ plane - weighted @ residual
            last, plane = plane, _solved(information, right, expected, length_of(plane))
            if np.abs(plane - last).max() < _CONVERGED * np.linalg.norm(plane):
                break
        correlation = _correlation(strip.local(grey), strip.local(seen))
        return RoadStep(plane, information, right, strip.relative_sigma), correlation


def with_slope(road_steps: Mapping[Ends, RoadStep], steps: Steps) -> dict[Ends, RoadStep]:
    """The lengths of a drive by the road, with the camera's pitch against it by the path of all ``steps``, unscaled.

    A car pitches on its springs, by which a length errs by 7 to 8 % a degree, and the images of the
    road tell its pitch poorly. Single directions of motion tell it poorly too, for the camera also
    rises and falls. Over eight metres around a frame the path is parallel to the road; where
    directions are noisy, it is so only on the average of many steps
    (``docs/design/scale-and-lengths.md``).
    """
    motions = {ends: motion for ends, motion in triangulated(steps).items() if ends in road_steps}
    if not motions:
        return dict(road_steps)
    ratios = [
        motion.length_unscaled / road_steps[ends].length_heights for ends, motion in motions.items()
    ]
    by_path = _path_directions(steps, _REACH_HEIGHTS * median(ratios))
    T_current_previous = invert(
        np.array([motion.relative_pose.T_from_to for motion in motions.values()])
    )
    own = -normalised(T_current_previous[:, :3, 3])
    usual = np.column_stack([running_median(axis, _USUAL_STEPS) for axis in own.T])
    around = np.array(
        [by_path.get(ends[1], often) for ends, often in zip(motions, usual, strict=True)]
    )
    noise = _OF_PATH * mad_sigma((own - around)[:, 1])
    share = 1.0 / (1.0 + (noise / np.deg2rad(_PITCH_SIGMA_DEG)) ** 2)
    sloped = dict(road_steps)
    for ends, direction in zip(motions, usual + share * (around - usual), strict=True):
        sloped[ends] = road_steps[ends].along(direction)
    return sloped


def _path_directions(steps: Steps, reach: float) -> dict[int, FloatArray]:
    """The direction ``(3,)`` of the path within ``reach`` of a frame, in its camera, by the frame."""
    found: dict[int, FloatArray] = {}
    frames = 1 + max((last for _, last in steps), default=0)
    for is_measured, consecutive in groupby(links(steps, frames), steps.__contains__):
        if not is_measured:
            continue
        run = list(consecutive)
        T = chain(np.array([steps[ends].relative_pose.T_from_to for ends in run]))
        places = path_distance(T)
        behind = interpolated(places - reach, places, T[:, :3, 3])
        ahead = interpolated(places + reach, places, T[:, :3, 3])
        chords = np.einsum("nba,nb->na", T[:, :3, :3], ahead - behind)
        seen_from = [run[0][0], *(last for _, last in run)]
        lengths = np.linalg.norm(chords, axis=1)
        for frame, chord, length in zip(seen_from, chords, lengths, strict=True):
            if length > reach:
                found[frame] = chord / length
    return found


@dataclass(frozen=True)
class _Strip:
    """Pixels ``(P,)`` that see a strip of a level road, rows from the first below the horizon, and rays ``(3, P)``.

    They lie on a grid; ``places`` are their rows and columns there, ``coverage`` ``(H, W)`` is the
    blurred mask of them, ``gradual`` the sigma of the blur, and ``relative_sigma`` that of step
    lengths. ``hidden`` is the distance of the nearest ground that is seen over that without what
    is fixed to the camera.
    """

    relative_sigma: float
    hidden: float
    rows: IntArray
    columns: IntArray
    rays: _Layer
    places: tuple[IntArray, IntArray]
    coverage: NDArray[np.float32]
    gradual: float

    def local(self, grey: NDArray[np.float32]) -> NDArray[np.float32]:
        """Grey levels ``(P,)`` without what changes slowly."""
        grid = np.zeros_like(self.coverage)
        grid[self.places] = grey
        blurred = cv2.GaussianBlur(grid, (0, 0), self.gradual)
        return grey - blurred[self.places] / self.coverage[self.places]


def _strip(
    intrinsics: Intrinsics,
    top_row: int,
    far: float,
    half_width: float,
    relative_sigma: float,
    visible: Mask,
) -> _Strip:
    """The strip of a length and half width in camera heights; it reaches farther where a bonnet hides its beginning."""
    v, u = np.mgrid[top_row : intrinsics.height, : intrinsics.width]
    rays = intrinsics.rays(np.stack([u, v], axis=-1))
    depth_heights = 1.0 / np.maximum(rays[..., 1], 1e-6)
    level = np.abs(rays[..., 0] * depth_heights) < half_width
    ground = depth_heights[level]
    step = max(round(float(np.sqrt((ground < far).sum() / _POINTS))), 1)
    hidden = float(depth_heights[level & visible].min(initial=far) / ground.min(initial=far))
    seen = level & visible & (depth_heights < hidden * far)
    rows, columns = np.nonzero(seen & (v % step == 0) & (u % step == 0))
    places = rows // step, columns // step
    mask = np.zeros((len(seen) // step + 1, intrinsics.width // step + 1), np.float32)
    mask[places] = 1.0
    gradual = _gradual_px(intrinsics) / step
    return _Strip(
        relative_sigma,
        hidden,
        rows,
        columns,
        np.ascontiguousarray(rays[rows, columns].T, dtype=np.float32),
        places,
        np.asarray(cv2.GaussianBlur(mask, (0, 0), gradual)),
        gradual,
    )


def _normal_along(direction: FloatArray) -> FloatArray:
    """The normal ``(3,)`` of a road, down, unit, that is level across a ``direction`` ``(3,)`` and parallel to it."""
    along = direction / max(length_of(direction), 1e-9)
    normal = _LEVEL - (_LEVEL @ along) * along
    return normal / np.linalg.norm(normal)


def _solved(
    information: FloatArray, right: FloatArray, normal: FloatArray, length: float
) -> FloatArray:
    """The plane ``m`` ``(3,)`` of normal equations and an expected normal, at about that length."""
    across = np.eye(3) - np.outer(normal, normal)
    prior = across / (np.deg2rad(_TILT_SIGMA_DEG) * max(length, 1e-6)) ** 2
    return np.linalg.solve(information + prior + 1e-9 * np.eye(3), right)


def _gradual_px(intrinsics: Intrinsics) -> float:
    """Sigma of the blur that leaves what changes slowly over the image, in pixels."""
    return max(0.01 * intrinsics.fx, 1.5)


def _single(*parts: FloatArray) -> tuple[_Layer, ...]:
    """In single precision, as the rays: one double operand would make all arithmetic double."""
    return tuple(part.astype(np.float32) for part in parts)


def _ahead(points: _Layer) -> _Layer:
    """Points ``(..., 3, P)`` with positive depth, also for a wrong plane."""
    np.maximum(points[..., 2, :], 1e-3, out=points[..., 2, :])
    return points


def _correlation(a: _Layer, b: _Layer) -> float:
    return float(a @ b) / max(length_of(a) * length_of(b), 1e-9)
