"""GPS beside the camera: its local frame east, north, up on the ellipsoid of WGS 84, the scale, places for the graph.

Fixes of a receiver share most of their error for seconds to minutes. So their sigmas are widened as
if only one fix in ``correlation_s`` were independent.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from slam.config.sections import GpsConfig
from slam.formats.trajectory import nearest_stamps
from slam.frames import GpsTrack
from slam.frontend import agreement
from slam.frontend.agreement import Agreement
from slam.frontend.scale import MIN_FRAMES, ScaleEstimate
from slam.geometry import se3
from slam.geometry.robust import mad_sigma, median
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import Failed, SlamError

logger = logging.getLogger(__name__)

_LEAST_FIXES = 3
_CHORDS = 10  # the path is divided into about so many chords to compare lengths
_LEAST_MOTION_SIGMAS = 5.0
_GOOD_CHORD_SIGMAS = 20.0  # fixes with sigmas of 2.5 and 5 m lengthen such a chord by 1 %
_UNKNOWN_HEIGHT_SIGMA_M = 100.0  # of fixes without a height, which are laid on a level
_LEAST_SPEED_M_S = 2.0  # receivers state speeds to some tenths
_UP_SIGMA = 0.2  # radians between the camera's own up and that of the earth
_ROUNDS = 30
_HUBER_K = 1.345
# of the ellipsoid of WGS 84
_A = 6378137.0  # half axes, metres
_B = 6356752.314245179
_E2 = 1.0 - (_B / _A) ** 2
_E2_SECOND = (_A / _B) ** 2 - 1.0


class GpsFixes:
    """The fixes taken during a drive.

    Attributes:
        stamps: seconds ``(M,)`` on the clock of the images.
        points: east, north, up ``(M, 3)``, metres; the antenna is taken to be at the camera.
        sigmas: of single fixes ``(M, 3)``, metres.
        widening: factor on the sigmas for a graph, which takes errors as independent.
        frame: where east, north, up begin.
        has_heights: whether the receiver gives them; else all fixes lie at height 0.
        agreement: of the fixes with the last path that was located by them.
    """

    def __init__(self, track: GpsTrack, frame_stamps: FloatArray, config: GpsConfig) -> None:
        """The fixes of a track between the first and the last of the frames' stamps ``(N,)``.

        Raises:
            SlamError: fewer than three fixes were taken during the drive.
        """
        shifted = track.stamps + config.offset_s
        inside = (shifted >= frame_stamps[0]) & (shifted <= frame_stamps[-1])
        if inside.sum() < _LEAST_FIXES:
            raise SlamError(
                f"{int(inside.sum())} GPS fixes lie between the first and the last frame: the track has stamps from "
                f"{shifted[0]:.1f} to {shifted[-1]:.1f} s, the frames from {frame_stamps[0]:.1f} to "
                f"{frame_stamps[-1]:.1f} s: set gps.offset_s, or give the track of this drive"
            )
        places = track.places[inside]
        self.has_heights = bool(np.isfinite(places).all())
        if not self.has_heights:
            places = np.nan_to_num(places)
        self.stamps, self.frame = shifted[inside], LocalFrame(places[0])
        self.points = self.frame.points(places)
        self._speeds = track.speeds[inside]
        up = config.vertical_sigma_m if self.has_heights else _UNKNOWN_HEIGHT_SIGMA_M
        own = np.array([config.sigma_m, config.sigma_m, up])
        self.sigmas: FloatArray = own * track.dilution[inside][:, None]
        self.widening = float(
            np.sqrt(max(config.correlation_s / median(np.diff(self.stamps)), 1.0))
        )
        self.agreement: Agreement | None = None
        self._frame_stamps = frame_stamps

    def scale(self, T_world_camera_unscaled: FloatArray) -> ScaleEstimate | Failed:
        """Metres per unit of an odometry ``(N, 4, 4)``: the median ratio of chords, so that outliers count little.

        Errors of fixes lengthen a chord by about their variance over its length. So chords are a
        tenth of the fixes, or several of them where these span less than 20 sigmas, and are chosen
        by the camera's lengths: choosing by GPS would prefer chords that errors lengthen. Speeds of
        the receiver, which do not share the errors of its places, give the lengths where it states
        them.
        """
        if (found := self._by_speeds(T_world_camera_unscaled)) is not None:
            return found
        estimated = self._camera(T_world_camera_unscaled)
        sigma = median(self.sigmas[:, 0])
        least = _LEAST_MOTION_SIGMAS * sigma

        def chords(span: int) -> list[FloatArray]:
            """By GPS, and by the camera."""
            both = (self.points, estimated)
            return [np.linalg.norm(p[span:] - p[:-span], axis=1) for p in both]

        tenth = max(len(estimated) // _CHORDS, 1)
        spans = range(tenth, max(len(estimated) // 2, tenth) + 1, tenth)
        longest = max(spans, key=lambda span: median(chords(span)[1]))
        by_gps, by_camera = chords(longest)
        metres = by_gps.sum() / max(by_camera.sum(), np.finfo(float).tiny)
        lengths = metres * chords(tenth)[1]
        usable = lengths > least
        if usable.sum() < MIN_FRAMES:
            return Failed(
                f"the camera moves too little: {int(usable.sum())} stretches of a tenth of the fixes span over "
                f"{least:.1f} m, five sigmas, and move in the images; {MIN_FRAMES} are needed, and the longest spans "
                f"{lengths.max():.1f} m; gps.sigma_m may be smaller for a good receiver"
            )
        good = _GOOD_CHORD_SIGMAS * sigma
        by_gps, by_camera = chords(
            next((s for s in spans if metres * np.median(chords(s)[1]) >= good), longest)
        )
        usable = metres * by_camera > least
        return _usual(by_gps[usable] / by_camera[usable])

    def _by_speeds(self, T_world_camera: FloatArray) -> ScaleEstimate | None:
        """The scale by what was driven at the stated speeds; None without any, or where too few tenths move."""
        known = np.isfinite(self._speeds)
        if not known.any():
            return None
        speeds = np.interp(self.stamps, self.stamps[known], self._speeds[known])
        driven = cumulative_trapezoid(speeds, self.stamps, initial=0)
        path = np.interp(self.stamps, self._frame_stamps, se3.path_distance(T_world_camera))
        edges = np.arange(0, len(path), max(len(path) // _CHORDS, 1))
        by_gps, by_camera = np.diff(driven[edges]), np.diff(path[edges])
        usable = (by_gps > _LEAST_SPEED_M_S * np.diff(self.stamps[edges])) & (by_camera > 0)
        if usable.sum() < MIN_FRAMES:
            return None
        return _usual(by_gps[usable] / by_camera[usable])

    def align(self, T_world_camera: FloatArray) -> FloatArray | Failed:
        """``T_enu_world`` ``(4, 4)`` by the fixes, robustly; about a straight path by the camera's own up."""
        camera = self._camera(T_world_camera)
        sigma = self.sigmas * self.widening
        extent = float(np.ptp(self.points[:, :2], axis=0).max())
        least = _LEAST_MOTION_SIGMAS * median(sigma[:, 0])
        if extent < least:
            return Failed(
                f"the camera moves too little for GPS to tell its heading: {extent:.1f} m, and {least:.1f} m are "
                "needed with these gps.sigma_m and gps.correlation_s"
            )
        up_world = -T_world_camera[:, :3, 1].mean(axis=0)
        by_up = np.outer([0.0, 0.0, 1.0], up_world) / _UP_SIGMA**2
        precision = 1.0 / (sigma**2).mean(axis=1)
        weights = precision
        for _ in range(_ROUNDS):
            share = (weights / weights.sum())[:, None]
            mean_enu, mean_world = (share * self.points).sum(axis=0), (share * camera).sum(axis=0)
            spread = (self.points - mean_enu).T @ (weights[:, None] * (camera - mean_world))
            R_enu_world = se3.nearest_rotation(spread + by_up)
            T_enu_world = se3.make(R_enu_world, mean_enu - R_enu_world @ mean_world)
            whitened = np.linalg.norm(
                (se3.apply(T_enu_world, camera) - self.points) / sigma, axis=1
            )
            weights = precision * np.minimum(1.0, _HUBER_K / np.maximum(whitened, 1e-9))
        return T_enu_world

    def locate(self, T_world_camera: FloatArray, give_lengths: bool) -> Location | Failed:
        """Where a trajectory ``(N, 4, 4)`` in metres lies on the earth; a failure is logged.

        Raises:
            SlamError: the fixes contradict the path, and ``give_lengths``: all are theirs.
        """
        T_enu_world = self.align(T_world_camera)
        if not isinstance(T_enu_world, Failed):
            distances = np.linalg.norm(self.offsets(T_enu_world @ T_world_camera)[:, :2], axis=1)
            path_m = float(se3.path_distance(T_world_camera)[-1])
            self.agreement = agreement.of_positions("GPS", distances, self.sigmas[:, 0], path_m)
            if not self.agreement.is_wrong:
                return Location(self, T_enu_world)
            if give_lengths:
                raise SlamError(
                    f"{self.agreement}; give the track and gps.offset_s of this drive, or another scale.mode"
                )
            T_enu_world = Failed(str(self.agreement))
        logger.warning("the GPS track is not used: %s", T_enu_world.reason)
        return T_enu_world

    def offsets(self, T_enu_camera: FloatArray) -> FloatArray:
        """From the fixes to the path at their times ``(M, 3)``, east, north and up."""
        return self._camera(T_enu_camera) - self.points

    def at_frames(
        self, T_enu_world: FloatArray, T_world_camera: FloatArray
    ) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
        """Every fix at the frame nearest in time, moved there by the camera's own motion.

        Frames ``(M,)``, east, north, up ``(M, 3)`` and sigmas ``(M, 3)`` for a graph, metres.
        """
        frames = nearest_stamps(self.stamps, self._frame_stamps)
        T_enu_camera = T_enu_world @ T_world_camera
        moved = T_enu_camera[frames, :3, 3] - self._camera(T_enu_camera)
        return frames, self.points + moved, self.widening * self.sigmas

    def _camera(self, T_any_camera: FloatArray) -> FloatArray:
        """Positions of the camera ``(M, 3)`` at the fixes, from its poses ``(N, 4, 4)``."""
        return se3.interpolated(self.stamps, self._frame_stamps, T_any_camera[:, :3, 3])


@dataclass(frozen=True)
class Location:
    """The fixes of a drive, and ``T_enu_world`` ``(4, 4)``: the world in axes east, north, up."""

    fixes: GpsFixes
    T_enu_world: FloatArray


class LocalFrame:
    """Axes east, north, up in metres, with their origin at a place."""

    def __init__(self, place: FloatArray) -> None:
        """At a place ``(3,)``: latitude and longitude in degrees, height in metres."""
        (latitude, longitude, _), origin = place, _earth_centred(place[None])[0]
        # about the axis of the earth until x is east, then about that until z is up
        turns = [90.0 + longitude, 90.0 - latitude]
        R_earth_local = Rotation.from_euler("ZX", turns, degrees=True).as_matrix()
        self._T_earth_local = se3.make(R_earth_local, origin)

    def points(self, places: FloatArray) -> FloatArray:
        """Points ``(N, 3)`` east, north, up of places ``(N, 3)``."""
        return se3.apply(se3.invert(self._T_earth_local), _earth_centred(places))

    def places(self, points: FloatArray) -> FloatArray:
        """Places ``(N, 3)`` of points ``(N, 3)``: the inverse of `points`, by Bowring's formula."""
        x, y, z = se3.apply(self._T_earth_local, points).T
        radius = np.hypot(x, y)
        parametric = np.arctan2(z * _A, radius * _B)
        latitude = np.arctan2(
            z + _E2_SECOND * _B * np.sin(parametric) ** 3,
            radius - _E2 * _A * np.cos(parametric) ** 3,
        )
        north, outward = np.sin(latitude), np.cos(latitude)
        height = radius * outward + z * north - _A * np.sqrt(1.0 - _E2 * north**2)
        return np.column_stack([np.rad2deg(latitude), np.rad2deg(np.arctan2(y, x)), height])


def _usual(ratios: FloatArray) -> ScaleEstimate:
    """The median of lengths by GPS over those by the camera ``(M,)``."""
    value = median(ratios)
    return ScaleEstimate(value, mad_sigma(np.log(ratios / value)), len(ratios))


def _earth_centred(places: FloatArray) -> FloatArray:
    """Places ``(N, 3)`` in the axes of the earth, metres."""
    latitude, longitude = np.deg2rad(places[:, :2]).T
    normal = _A / np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
    radius = (normal + places[:, 2]) * np.cos(latitude)
    z = (normal * (1.0 - _E2) + places[:, 2]) * np.sin(latitude)
    return np.column_stack([radius * np.cos(longitude), radius * np.sin(longitude), z])
