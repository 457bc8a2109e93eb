"""How far a source of lengths, poses or depth contradicts the images' own motion, by robust statistics."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slam.frames import Ends, RelativePose
from slam.frontend.visual.depth_error import DepthError
from slam.frontend.visual.motion import Motion
from slam.geometry.robust import mad_sigma
from slam.geometry.se3 import FloatArray, invert, rotation_angle

logger = logging.getLogger(__name__)

DOUBTFUL, WRONG = 2.0, 5.0  # sigmas
_ROTATION_RAD, _DIRECTION_RAD = np.deg2rad(0.3), np.deg2rad(3.0)  # of a step by images
_HEIGHT = 0.1  # relative, of a stated camera height and of the road that images show
_USUAL_HEIGHT_M, _USUAL_FACTOR = 1.0, 10.0  # of cameras whose height nobody stated
_DEPTH = 0.2  # relative, of a good source of depth
_DRIFT = 0.005  # of the distance travelled, what an aligned path keeps of it
_LEAST = 5  # compared values


@dataclass(frozen=True)
class Agreement:
    """A ``source`` is ``sigmas`` of the stated noise away from what images show; ``figure`` says it in words."""

    source: str
    sigmas: float
    figure: str

    @property
    def is_wrong(self) -> bool:
        """Whether the source may not decide anything."""
        return self.sigmas > WRONG

    def __str__(self) -> str:
        return f"{self.source} contradicts the images by {self.sigmas:.1f} sigmas: {self.figure}"

    def said(self) -> Agreement:
        """The same, in the log; as a warning where it is doubtful."""
        text = str(self) if self.sigmas > DOUBTFUL else f"{self.source} agrees with the images: {self.figure}"
        logger.log(logging.WARNING if self.sigmas > DOUBTFUL else logging.INFO, "%s", text)
        return self


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
