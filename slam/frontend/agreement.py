"""How far a source of lengths, poses or depth contradicts the images' own motion, by robust statistics.

Also how far the images of a drive are from those of good drives, and the confidence that follows
from both.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from erfsfm.common.readers.frame_range import runs
from slam.frames import Ends, Intrinsics, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.measured import named
from slam.frontend.self_calibration import SURE, FoundCamera, check_camera
from slam.frontend.visual.depth_error import DepthError
from slam.frontend.visual.motion import Motion
from slam.geometry.robust import mad_sigma, median
from slam.geometry.se3 import FloatArray, invert, path_distance, rotation_angle
from slam.runtime.errors import Failed, SlamError

logger = logging.getLogger(__name__)

DOUBTFUL, _CLEAR, WRONG = 2.0, 3.0, 5.0  # sigmas
_ROTATION_RAD, _DIRECTION_RAD = np.deg2rad(0.3), np.deg2rad(3.0)  # of a step by images
_HEIGHT = 0.1  # relative, of a stated camera height and of the road that images show
_USUAL_HEIGHT_M, _USUAL_FACTOR = 1.0, 10.0  # of cameras whose height nobody stated
_DEPTH = 0.2  # relative, of a good source of depth
_DRIFT = 0.005  # of the distance travelled, what an aligned path keeps of it
_LEAST = 5  # compared values
# of good drives (docs/reliability.md): mean and spread
_USUAL_SUPPORT, _SUPPORT_SPREAD = 0.6, 0.13
_WEAK_SUPPORT, _LEAST_WEAK = 0.2, 10  # and frames in a row that are a doubt
_ON_ROAD_SPREAD = 0.2
_FAR_SPREAD = 0.18  # of the logarithm
_CONTRADICTED_SPREAD, _LEAP_SPREAD = 0.007, 0.1
_LEAST_MOVED = 0.1  # of long steps
_LEAST_APART = 0.1  # between poses whose directions are compared: shorter steps are noise
_ALONG = np.cos(np.deg2rad(20.0))  # of the directions of steps
_ASIDE_SPREAD = 0.01
_INTERPOLATED_SPREAD, _SEGMENT_SIGMAS = 0.03, 3.0
# of `share_right`, by tools/fit_confidence.py of commit 669cc2b1
CONFIDENCE = (0.97, 3.0, 5.5)
SHAPE_WITHIN = 0.01, 0.03  # of the path, by a vehicle and by a carried camera
# of a path along a road that is stretched, the error over the path and the stretch
_STRETCHED = 0.29
_CAPPED = 3.0  # sigmas of what leaves a confidence of less than a half


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
        text = (
            str(self)
            if self.sigmas > DOUBTFUL
            else f"{self.source} agrees with {self.beside}: {self.figure}"
        )
        # as a format: where warnings of a kind are counted, each is of its own
        logger.log(logging.WARNING if self.sigmas > DOUBTFUL else logging.INFO, text)
        return self

    def required(self) -> Agreement:
        """As `said`, of a source that the run has to take.

        Raises:
            SlamError: the source is wrong.
        """
        if self.is_wrong:
            raise SlamError(f"{self}; check its files and settings, or run without it")
        return self.said()


def of_height(source: str, implied_m: float, stated_m: float | None, spread: float) -> Agreement:
    """By the camera's height above the road.

    Args:
        source: its name in a sentence.
        implied_m: the height that lengths of the source imply, metres.
        stated_m: the height that the user or the data set states, metres; None where nobody does.
        spread: relative sigma of the road that the images show.
    """
    wanted, noise = (
        (_USUAL_HEIGHT_M, np.log(_USUAL_FACTOR)) if stated_m is None else (stated_m, _HEIGHT)
    )
    sigmas = abs(np.log(max(implied_m, 1e-12) / wanted)) / np.hypot(noise, spread)
    told = "" if stated_m is None else f", and {stated_m:g} m are stated"
    return Agreement(
        source, float(sigmas), f"by it the camera is {implied_m:.3g} m above the road{told}"
    )


def of_steps(
    source: str, steps: Sequence[RelativePose], motions: Mapping[Ends, Motion]
) -> Agreement | None:
    """By rotations and directions of the steps that both measured.

    Args:
        source: its name in a sentence.
        steps: as the source measured them, in any unit.
        motions: as the images measured them, by their frames.

    Returns:
        None where fewer than five steps were measured by both.
    """
    both = [step for step in steps if step.ends in motions]
    if len(both) < _LEAST:
        return None
    by_source = np.array([step.T_from_to for step in both])
    by_images = np.array([motions[step.ends].relative_pose.T_from_to for step in both])
    noise = np.array([step.sigmas for step in both])
    turned = rotation_angle((invert(by_source) @ by_images)[:, :3, :3])
    length_source = np.linalg.norm(by_source[:, :3, 3], axis=1)
    length_images = np.linalg.norm(by_images[:, :3, 3], axis=1)
    along = np.einsum("ni,ni->n", by_source[:, :3, 3], by_images[:, :3, 3])
    along /= np.maximum(length_source * length_images, 1e-12)
    apart = np.arccos(np.clip(along, -1, 1))
    of_direction = np.hypot(_DIRECTION_RAD, np.arctan2(noise[:, 3:].max(axis=1), length_source))
    sigmas = max(
        median(turned / np.hypot(_ROTATION_RAD, np.linalg.norm(noise[:, :3], axis=1))),
        median(apart / of_direction),
    )
    degrees = np.rad2deg([np.median(turned), np.median(apart)])
    return Agreement(
        source,
        sigmas,
        f"its steps turn {degrees[0]:.2f} and point {degrees[1]:.1f} degrees off, median",
    )


def of_positions(
    source: str, distances: FloatArray, sigmas: FloatArray, path_m: float
) -> Agreement:
    """By the distances of the aligned path from positions of the source.

    Args:
        source: its name in a sentence.
        distances: ``(M,)``, metres.
        sigmas: of the positions ``(M,)``, metres.
        path_m: length of the path, of which an alignment keeps a small part as drift.
    """
    noise = np.hypot(sigmas, _DRIFT * path_m)
    usual = median(distances)
    return Agreement(
        source,
        mad_sigma(distances / noise),
        f"its positions lie {usual:.1f} m off the path, median",
    )


def of_directions(T_odometry: FloatArray) -> Agreement:
    """By poses ``(N, 4, 4)`` of a vehicle: it goes along one axis of its camera, forwards or backwards."""
    tenths = np.floor(path_distance(T_odometry) / _LEAST_APART)
    is_apart = np.diff(tenths, prepend=-1.0) > 0
    is_apart[-1] = True
    apart = T_odometry[is_apart]
    steps = (invert(apart[:-1]) @ apart[1:])[:, :3, 3]
    lengths = np.linalg.norm(steps, axis=1)
    moved = steps[lengths > _LEAST_MOVED * np.quantile(lengths, 0.9)]
    _, axes = np.linalg.eigh(moved.T @ moved)
    along = np.abs(moved @ axes[:, -1]) / np.linalg.norm(moved, axis=1)
    aside = float((along < _ALONG).mean()) if len(moved) else 0.0
    figure = f"{100 * aside:.1f} % of them point {np.rad2deg(np.arccos(_ALONG)):.0f} degrees or more aside"
    return Agreement("the direction of steps", aside / _ASIDE_SPREAD, figure, "good drives").said()


def of_depth(source: str, error: DepthError) -> Agreement | None:
    """By the spread of its ratio to triangulated depth; None where few corners tell."""
    spread = error.total_spread
    if spread is None:
        return None
    return Agreement(
        source, spread / _DEPTH, f"its ratio to triangulated depth varies by {100 * spread:.0f} %"
    )


def of_images(
    drive: Drive, camera: Intrinsics, contradicted: Mapping[Ends, float], needs_road: bool
) -> list[Agreement]:
    """How far the images of a completed drive are from those of good drives, in the log too.

    Args:
        drive: all its measurements.
        camera: that of the images.
        contradicted: steps whose length learned depth or the speed before contradicts, and how the speed leaps there.
        needs_road: whether lengths are measured on the road.
    """
    agreements: list[Agreement] = []

    def compared(source: str, sigmas: float, figure: str) -> None:
        agreements.append(Agreement(source, sigmas, figure, "good drives"))

    frames = len(drive)
    interpolated = len(drive.interpolated)
    guessed = len(drive.segments) - 1
    # with maps of keyframes, lengths are those of the maps
    steps = 0 if drive.by_keyframes else len(drive.triangulated)
    on_road = len(drive.road_steps)
    gaps = float(np.hypot(interpolated / frames / _INTERPOLATED_SPREAD, _SEGMENT_SIGMAS * guessed))
    figure = f"{interpolated} of {frames} frames are interpolated"
    figure += f", the places of {guessed} segments guessed" if guessed else ""
    compared("gaps", gaps, figure)
    if steps:
        figure = f"learned depth or the speed before contradict {len(contradicted)} of {steps}"
        if contradicted:
            figure += f", which end at frames {named([last for _, last in contradicted])}"
        leap = max(map(abs, contradicted.values()), default=0.0)
        sigmas = max(len(contradicted) / steps / _CONTRADICTED_SPREAD, leap / _LEAP_SPREAD)
        if leap > DOUBTFUL * _LEAP_SPREAD:
            figure += f": the speed leaps by a factor of {np.exp(leap):.1f}, so the unit holds to {50 * leap:.0f} %"
        compared("the length of steps", sigmas, figure)
    corners_were_asked = drive.steps or drive.measured.failures
    if corners_were_asked and (support := drive.support) is not None:
        compared("the overlap of images", *_overlap(support))
    if drive.measured.is_upside_down:
        figure = "what is high in the images is nearer than what is low: turn them by 180 degrees"
        compared("the way up of the camera", 2.0 * WRONG, figure)
    if needs_road and steps >= _LEAST:
        sigmas = (1.0 - on_road / steps) / _ON_ROAD_SPREAD
        figure = f"{on_road} of {steps} lengths were measured on the road; the others follow from learned depth"
        compared("the view of the road", sigmas, figure)
    too_far = drive.measured.depth_error.most_too_far()
    if needs_road and steps and too_far is not None:
        figure = f"it is up to {100 * np.expm1(too_far):.0f} % farther than triangulated, as where a lens zooms"
        compared("learned depth far away", too_far / _FAR_SPREAD, figure)
    found = check_camera(drive.measured.corners, camera)
    if (by_corners := of_focal_length(found, camera)) is not None:
        agreements.append(by_corners)
    for each in agreements[1:]:  # gaps and segments were said by their frames
        each.said()
    return agreements


def _overlap(support: FloatArray) -> tuple[float, str]:
    """Sigmas and figure of the support of all frames ``(N,)``; many weak frames in a row are a doubt of their own."""
    mean = float(support.mean())
    sigmas = max((_USUAL_SUPPORT - mean) / _SUPPORT_SPREAD, 0.0)
    figure = f"{100 * mean:.0f} % of the corners fit in the next image"
    weak = runs(np.flatnonzero(support < _WEAK_SUPPORT).tolist())
    if long := [f"{first} to {last}" for first, last in weak if last - first + 1 >= _LEAST_WEAK]:
        figure += f", of frames {', '.join(long)} less than {100 * _WEAK_SUPPORT:.0f} %"
        sigmas = max(sigmas, _CAPPED)
    return sigmas, figure


def of_focal_length(found: FoundCamera, camera: Intrinsics) -> Agreement | None:
    """By the one that windows of corners show; None where it is not contradicted. A rough guess is always a doubt."""
    sigmas, figure = found.sigmas_from(camera), ""
    if sigmas > _CLEAR:
        figure = f"{found.sentence(camera.width)}: try --camera auto"
    if camera.focal_sigma > SURE:
        figure = figure or "nobody calibrated it"
        return Agreement("the guessed focal length", max(sigmas, _CAPPED), figure, "good drives")
    return Agreement("the focal length", sigmas, figure) if figure else None


def confidence(
    agreements: Iterable[Agreement], is_metric: bool, is_carried: bool, focal_sigma: float = 0.0
) -> float | Failed:
    """The share of drives with as large a contradiction that err by at most 1 % of their path.

    Args:
        agreements: of all sources of the drive.
        is_metric: whether lengths are in metres.
        is_carried: whether a person carries the camera.
        focal_sigma: relative, of a focal length that nobody calibrated: it stretches the road.

    Returns:
        A failure for drives of which it is not known.
    """
    if is_carried:
        return Failed("it is calibrated on roads, not for a camera that is carried")
    if not is_metric:
        return Failed("it is calibrated for lengths in metres")
    share = shape_confidence(agreements)
    stretched = _STRETCHED * np.sqrt(2.0) * focal_sigma
    return min(share, float(erf(0.01 / stretched))) if stretched else share


def shape_confidence(agreements: Iterable[Agreement], drift: float = 0.0) -> float:
    """As `confidence`, of the shape alone: the error after one fitted scale is at most one of `SHAPE_WITHIN`.

    Args:
        agreements: of all sources.
        drift: of a carried camera, sigma of its positions over the path: 1 % of it speaks as one sigma does.
    """
    largest = max((each.sigmas for each in agreements), default=0.0)
    return float(share_right(max(largest, 100.0 * drift), CONFIDENCE))


def share_right(sigmas: FloatArray | float, constants: tuple[float, float, float]) -> FloatArray:
    """The share of drives that err by at most 1 % of their path, by their largest contradiction ``(N,)``.

    Args:
        sigmas: of the contradictions.
        constants: the best share, the sigmas that halve it, and how steeply it falls.
    """
    best, half, steepness = constants
    return best / (1.0 + (np.maximum(sigmas, 0.0) / half) ** steepness)
