"""How far a source of lengths, poses or depth contradicts the images' own motion, by robust statistics.

Also how far the images of a drive are from those of good drives, and the confidence that follows from both.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slam.frames import Ends, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.segments import named
from slam.frontend.visual.depth_error import DepthError
from slam.frontend.visual.motion import Motion
from slam.frontend.visual.odometry import OdometryState
from slam.geometry.robust import mad_sigma
from slam.geometry.se3 import FloatArray, invert, rotation_angle
from slam.runtime.errors import SlamError

logger = logging.getLogger(__name__)

DOUBTFUL, WRONG = 2.0, 5.0  # sigmas
_ROTATION_RAD, _DIRECTION_RAD = np.deg2rad(0.3), np.deg2rad(3.0)  # of a step by images
_HEIGHT = 0.1  # relative, of a stated camera height and of the road that images show
_USUAL_HEIGHT_M, _USUAL_FACTOR = 1.0, 10.0  # of cameras whose height nobody stated
_DEPTH = 0.2  # relative, of a good source of depth
_DRIFT = 0.005  # of the distance travelled, what an aligned path keeps of it
_LEAST = 5  # compared values
_FOCAL = 0.06  # relative, of the focal length that corners show: flow and lens bias it
# of good drives (docs/reliability.md): mean and spread
USUAL_SUPPORT, _SUPPORT_SPREAD = 0.6, 0.13
_ON_ROAD, _ON_ROAD_SPREAD = 1.0, 0.2
_FAR_SPREAD, _FAR_CORNERS = 0.18, 0.05  # of the logarithm; and least corners over the most of a distance
_CONTRADICTED_SPREAD = 0.007
_INTERPOLATED_SPREAD, _SEGMENT_SIGMAS = 0.03, 3.0
# share of drives whose largest contradiction has so many sigmas that err by at most 1 % of their path
_SIGMAS, _CONFIDENCE = (1.0, 1.5, 2.0, 3.0, 5.0), (0.97, 0.85, 0.5, 0.2, 0.05)


@dataclass(frozen=True)
class Agreement:
    """A ``source`` is ``sigmas`` of the stated noise away from ``beside``; ``figure`` says it in words."""

    source: str
    sigmas: float
    figure: str
    beside: str = "the images"

    @property
    def is_wrong(self) -> bool:
        """Whether the source may not decide anything."""
        return self.sigmas > WRONG

    def __str__(self) -> str:
        return f"{self.source} contradicts {self.beside} by {self.sigmas:.1f} sigmas: {self.figure}"

    def said(self) -> Agreement:
        """The same, in the log; as a warning where it is doubtful."""
        text = str(self) if self.sigmas > DOUBTFUL else f"{self.source} agrees with {self.beside}: {self.figure}"
        # as a format: where warnings of a kind are counted, each is of its own
        logger.log(logging.WARNING if self.sigmas > DOUBTFUL else logging.INFO, text)
        return self

    def required(self) -> Agreement:
        """As `said`, of a source that the run has to take; ``SlamError`` where it is wrong."""
        if self.is_wrong:
            raise SlamError(f"{self}; check its files and settings, or run without it")
        return self.said()


def of_height(source: str, implied_m: float, stated_m: float | None, spread: float) -> Agreement:
    """By the camera's height above the road that lengths of the source imply, with the relative spread of the road."""
    wanted, noise = (_USUAL_HEIGHT_M, np.log(_USUAL_FACTOR)) if stated_m is None else (stated_m, _HEIGHT)
    sigmas = abs(np.log(max(implied_m, 1e-12) / wanted)) / np.hypot(noise, spread)
    told = "" if stated_m is None else f", and {stated_m:g} m are stated"
    return Agreement(source, float(sigmas), f"by it the camera is {implied_m:.3g} m above the road{told}")


def of_steps(source: str, steps: Sequence[RelativePose], motions: Mapping[Ends, Motion]) -> Agreement | None:
    """By rotations and directions of the steps that both measured; None where these are few."""
    pairs = [(step, motions[step.ends].relative_pose.T_from_to) for step in steps if step.ends in motions]
    if len(pairs) < _LEAST:
        return None
    by_source, by_images = np.array([step.T_from_to for step, _ in pairs]), np.array([T for _, T in pairs])
    noise = np.array([step.sigmas for step, _ in pairs])
    turned = rotation_angle((invert(by_source) @ by_images)[:, :3, :3])
    lengths = [np.linalg.norm(T[:, :3, 3], axis=1) for T in (by_source, by_images)]
    along = np.einsum("ni,ni->n", by_source[:, :3, 3], by_images[:, :3, 3]) / np.maximum(lengths[0] * lengths[1], 1e-12)
    apart = np.arccos(np.clip(along, -1, 1))
    of_direction = np.hypot(_DIRECTION_RAD, np.arctan2(noise[:, 3:].max(axis=1), lengths[0]))
    sigmas = max(
        float(np.median(turned / np.hypot(_ROTATION_RAD, np.linalg.norm(noise[:, :3], axis=1)))),
        float(np.median(apart / of_direction)),
    )
    degrees = np.rad2deg([np.median(turned), np.median(apart)])
    return Agreement(source, sigmas, f"its steps turn {degrees[0]:.2f} and point {degrees[1]:.1f} degrees off, median")


def of_positions(source: str, distances: FloatArray, sigmas: FloatArray, path_m: float) -> Agreement:
    """By distances ``(M,)`` of the aligned path from its positions with ``sigmas`` ``(M,)``, metres."""
    noise = np.hypot(sigmas, _DRIFT * path_m)
    median = float(np.median(distances))
    return Agreement(source, mad_sigma(distances / noise), f"its positions lie {median:.1f} m off the path, median")


def of_depth(source: str, error: DepthError) -> Agreement | None:
    """By the spread of its ratio to triangulated depth; None where few corners tell."""
    spread = error.total_spread
    if spread is None:
        return None
    return Agreement(source, spread / _DEPTH, f"its ratio to triangulated depth varies by {100 * spread:.0f} %")


def of_images(
    drive: Drive, odometry: OdometryState, support: FloatArray, contradicted: Sequence[Ends], needs_road: bool
) -> list[Agreement]:
    """How far the images of a completed drive are from those of good drives, in the log too.

    Args:
        drive: all its measurements.
        odometry: what its corners say of the camera and of learned depth.
        support: of the frames ``(N,)``, by `frame_support`.
        contradicted: steps whose length learned depth or the speed before contradicts.
        needs_road: whether lengths are measured on the road.
    """
    frames, interpolated, guessed = len(drive), len(drive.interpolated), len(drive.segments) - 1
    steps = 0 if drive.maps else len(drive.steps.triangulated)  # lengths are then those of the maps
    on_road, mean = len(drive.road_steps), float(support.mean())
    gaps = float(np.hypot(interpolated / frames / _INTERPOLATED_SPREAD, _SEGMENT_SIGMAS * guessed))
    figure = f"{interpolated} of {frames} frames are interpolated, the places of {guessed} segments guessed"
    found = [("gaps", gaps, figure)]
    if steps:
        figure = f"learned depth or the speed before contradict {len(contradicted)} of {steps}"
        figure += f", which end at frames {named([last for _, last in contradicted])}" if contradicted else ""
        found.append(("the length of steps", len(contradicted) / steps / _CONTRADICTED_SPREAD, figure))
    if drive.motions or drive.failures or drive.map_poses.segments:  # else nothing was asked of the corners
        figure = f"{100 * mean:.0f} % of the corners fit in the next image"
        found.append(("the overlap of images", float(_support_sigmas(mean)), figure))
    if needs_road and steps >= _LEAST:
        sigmas = (_ON_ROAD - on_road / steps) / _ON_ROAD_SPREAD
        figure = f"{on_road} of {steps} lengths were measured on the road; the others follow from learned depth"
        found.append(("the view of the road", sigmas, figure))
    too_far = odometry.depth_error.most_too_far(_FAR_CORNERS)
    if needs_road and steps and too_far is not None:
        figure = f"it is up to {100 * np.expm1(too_far):.0f} % farther than triangulated, as where a lens zooms"
        found.append(("learned depth far away", too_far / _FAR_SPREAD, figure))
    agreements = [Agreement(source, sigmas, figure, "good drives") for source, sigmas, figure in found]
    if odometry.focal_length.error is not None:
        logarithm, sigma = odometry.focal_length.error
        figure = f"corners show {100 * np.exp(logarithm):.0f} % of it, with a sigma of {100 * sigma:.0f} %"
        sigmas = abs(logarithm) / float(np.hypot(_FOCAL, sigma))
        agreements.append(Agreement("the focal length", sigmas, figure))
    return [agreements[0], *(each.said() for each in agreements[1:])]  # gaps and segments were said by their frames


def frame_support(frames: range, motions: Iterable[Motion], located: Collection[int]) -> FloatArray:
    """The support of the motion to each frame ``(N,)``, 0 without one; the first has that of the next.

    Frames ``located`` in a map have the usual one, as a first frame without a next.
    """
    found = dict.fromkeys(located, USUAL_SUPPORT)
    for motion in motions:
        found[motion.ends[1]] = max(found.get(motion.ends[1], 0.0), motion.support)
    found[0] = found.get(1, 0.0) if len(frames) > 1 else USUAL_SUPPORT
    return np.array([found.get(frame, 0.0) for frame in frames])


def confidence(agreements: Iterable[Agreement]) -> float:
    """The share of drives with as large a contradiction that err by at most 1 % of their path."""
    return float(np.interp(max((each.sigmas for each in agreements), default=0.0), _SIGMAS, _CONFIDENCE))


def confidence_of_frames(support: FloatArray) -> FloatArray:
    """The same for every frame ``(N,)``, by its support alone."""
    return np.interp(_support_sigmas(support), _SIGMAS, _CONFIDENCE)


def _support_sigmas(support: FloatArray | float) -> FloatArray:
    return np.maximum((USUAL_SUPPORT - np.asarray(support)) / _SUPPORT_SPREAD, 0.0)
