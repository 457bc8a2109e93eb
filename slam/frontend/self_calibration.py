"""The camera of a recording that nobody calibrated: focal length, lens and principal point, where it turns.

Corners of the first images are followed from keyframe to keyframe. Each window of keyframes is reconstructed at one
guessed focal length, and then at others along the direction that driving straight on cannot see: lengths along the
axis grow as the focal length, turns shrink. From the lowest cost of this profile a bundle adjustment frees the focal
length, two radial coefficients and the principal point. From one guess it would not converge. Windows are joined
robustly, with sigmas as measured on recordings with a calibration (``docs/own-camera.md``).

Images are measured in half their width from their middle, so that nothing here knows their size; the lens then does
not move with the focal length.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from erfsfm.common.processes import limit_library_threads
from erfsfm.common.readers.camera_file import UNKNOWN_FX_SIGMA, CameraFile
from slam.frames import Frame
from slam.frontend.tracking import Search, Texture, are_inside, new_corners, track
from slam.frontend.window_adjustment import (
    ALL,
    BUT_FOCAL,
    KEYFRAMES,
    LEAST_KEYFRAMES,
    NOTHING,
    PRIOR,
    WINDOWS,
    Problem,
    Reconstruction,
    Sightings,
    normalised,
    reconstructed,
)
from slam.geometry.robust import mad_sigma, median, weighted_median
from slam.geometry.se3 import FloatArray, make

MOST_FRAMES = 450
SURE, ROUGH = 0.05, 0.12  # relative sigmas below which a focal length is found, or roughly
_WIDTH_PX = 960  # of the images that are followed
_SEARCH = Search(side=16, levels=4, limits=(20, 0.02), back=None, error_px=0.5, norm=np.inf)
_TEXTURE = Texture(quality=0.01, spacing_px=10.0, block_px=5)
_CORNERS = 500
_MOVED = 0.06  # of half the width, from keyframe to keyframe
_LOST = 0.5  # of the corners of the last keyframe
_LEAST_SIGHTINGS = 600  # of a window that counts
_GUESSES_DEG = 60.0, 85.0
# the formal sigma of a window is several times too small, and rectified images keep an error of their lens
_INFLATED, _FLOOR, _SYSTEMATIC = 3.0, 0.03, 0.02
_HUBER = 1.5


@dataclass(frozen=True)
class FoundCamera:
    """A camera by its own images: ``focal`` and, from the middle, ``centre`` in half widths; ``radial`` k1 and k2.

    ``sigma`` is relative, of the focal length; ``turn_deg`` the largest turn of the axis in one of
    the ``windows`` that tell.
    """

    focal: float
    radial: tuple[float, float]
    centre: tuple[float, float]
    sigma: float
    windows: int
    turn_deg: float

    def as_file(self, guess: CameraFile, source: str) -> CameraFile:
        """The camera file in place of a ``guess``, whose size, rate and height hold."""
        half = guess.width / 2
        keys: dict[str, Any] = {
            "fx": round(self.focal * half, 2),
            "fy": round(self.focal * half, 2),
            "cx": round(guess.cx + self.centre[0] * half, 2),
            "cy": round(guess.cy + self.centre[1] * half, 2),
        }
        if any(self.radial):
            first, second = (round(value, 5) for value in self.radial)
            keys |= {"model": "opencv", "distortion": (first, second, 0.0, 0.0)}
        return guess.model_copy(update=keys | {"fx_sigma": round(self.sigma, 4), "source": source})

    def sentence(self, width: int) -> str:
        """What the user is told of it, for images of this width in pixels."""
        fov_deg = 2.0 * np.rad2deg(np.arctan(1.0 / self.focal))
        if self.sigma > ROUGH:
            return (
                "the focal length cannot be seen: the camera does not turn; lengths along the road may be wrong by a "
                f"third: turn it once, state fov= or give GPS; fov={fov_deg:.0f} is taken"
            )
        roughly = ", roughly" if self.sigma > SURE else ""
        windows = (
            "1 window that turns" if self.windows == 1 else f"{self.windows} windows that turn"
        )
        return (
            f"the focal length is {self.focal * width / 2:.0f} px ± {100 * self.sigma:.1f} % (fov={fov_deg:.0f})"
            f"{roughly}, found from {windows} by up to {self.turn_deg:.0f} degrees"
        )


def find_camera(frames: Iterable[Frame]) -> FoundCamera:
    """The camera of images of one size, in their order; the prior's with its sigma where it cannot be seen."""
    with limit_library_threads():  # the systems are small
        seen, pixel = follow(frames)
        windows = [calibrated(part, pixel) for part in windows_that_turn(seen)]
    return joined(window for window in windows if window is not None)


class Window(NamedTuple):
    """What one window says: ``lens`` ``(5,)``, ``sigma`` of the first, and the largest turn of its axis."""

    lens: FloatArray
    sigma: float
    sightings: int
    turn_deg: float
    at_end: bool


def follow(frames: Iterable[Frame]) -> tuple[Sightings, float]:
    """Sightings of corners in the keyframes of some frames, and the size of a pixel in half widths."""
    rows: list[FloatArray] = []
    pixels, ids = np.zeros((0, 2), np.float32), np.zeros(0, np.int64)
    last, last_ids, sought, width, before = pixels, ids, 0, 1, None
    for frame in frames:
        frame = _narrow(frame)
        height, width = frame.grey.shape
        if before is not None:
            pixels, kept = track(before, frame.grey, pixels, _SEARCH)
            kept &= are_inside(pixels, (height, width))
            pixels, ids = pixels[kept], ids[kept]
        before = frame.grey
        _, own, at_last = np.intersect1d(ids, last_ids, return_indices=True)
        moved = np.linalg.norm(pixels[own] - last[at_last], axis=1)
        if len(own) > _LOST * len(last_ids) and median(moved) < _MOVED * width / 2:
            continue
        corners = new_corners(frame, pixels, _CORNERS - len(pixels), _TEXTURE)
        pixels = np.concatenate([pixels, corners])
        ids = np.concatenate([ids, sought + np.arange(len(corners))])
        sought += len(corners)
        last, last_ids = pixels, ids
        image = (pixels - [(width - 1) / 2, (height - 1) / 2]) * (2.0 / width)
        rows.append(np.column_stack([np.full(len(ids), len(rows)), ids, image]))
    table = np.concatenate(rows) if rows else np.zeros((0, 4))
    return Sightings(
        table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2:]
    ), 2.0 / width


def windows_that_turn(seen: Sightings) -> list[Sightings]:
    """The windows of keyframes whose images go furthest aside, at most six, the first keyframe of each its row 0."""
    keyframes = int(seen.keyframe.max(initial=-1)) + 1
    aside = np.zeros((keyframes, 2))
    for k in range(1, keyframes):
        rows, earlier = np.flatnonzero(seen.keyframe == k), np.flatnonzero(seen.keyframe == k - 1)
        _, own, before = np.intersect1d(seen.point[rows], seen.point[earlier], return_indices=True)
        moved = seen.image[rows[own]] - seen.image[earlier[before]]
        aside[k] = aside[k - 1] + (np.median(moved, axis=0) if len(moved) else 0.0)
    count = min(KEYFRAMES, keyframes)
    starts = range(0, keyframes - count + 1, KEYFRAMES // 2)
    turns = [
        float(np.ptp(aside[start : start + count], axis=0).max(initial=0.0)) for start in starts
    ]
    windows = []
    for n in np.argsort(turns)[::-1][:WINDOWS].tolist():
        rows = np.flatnonzero((seen.keyframe >= starts[n]) & (seen.keyframe < starts[n] + count))
        part, _ = seen.chosen(rows, least=3)
        windows.append(replace(part, keyframe=part.keyframe - starts[n]))
    return windows


def turning(
    seen: Sightings, lens: FloatArray, pixel: float
) -> tuple[Problem, Reconstruction] | None:
    """A start where parallax is too little: all keyframes turn on the spot, and points are far away."""
    rays = normalised(np.column_stack([seen.image * np.exp(-lens[0]), np.ones(len(seen))]))
    R = [np.eye(3)]
    for k in range(1, int(seen.keyframe.max(initial=-1)) + 1):
        rows, earlier = np.flatnonzero(seen.keyframe == k), np.flatnonzero(seen.keyframe == k - 1)
        _, own, before = np.intersect1d(seen.point[rows], seen.point[earlier], return_indices=True)
        if len(own) < 15:
            break
        turn, _ = Rotation.align_vectors(rays[rows[own]], rays[earlier[before]])
        for _ in range(8):
            turned = turn.apply(rays[earlier[before]])
            error = np.linalg.norm(rays[rows[own]] - turned, axis=1)
            weights = 1.0 / (1.0 + (error / max(mad_sigma(error), 0.5 * pixel)) ** 2)
            turn, _ = Rotation.align_vectors(rays[rows[own]], rays[earlier[before]], weights)
        R.append(turn.as_matrix() @ R[-1])
    if len(R) < LEAST_KEYFRAMES:
        return None
    part, kept = seen.chosen(seen.keyframe < len(R), least=2)
    directions = np.zeros((len(kept), 4))
    chosen = rays[np.isin(seen.point, kept) & (seen.keyframe < len(R))]
    np.add.at(
        directions[:, :3], part.point, np.einsum("sji,sj->si", np.array(R)[part.keyframe], chosen)
    )
    directions[:, :3] = normalised(directions[:, :3])
    directions[:, 3] = 0.1
    T = make(np.array(R), 1e-3 * np.random.default_rng(0).normal(size=(len(R), 3)))
    problem, start = Problem(part, len(R)), Reconstruction(T, normalised(directions), lens)
    start, _ = problem.solved(start, NOTHING, 2.0 * pixel, 10)
    return problem, problem.solved(start, NOTHING, 0.7 * pixel, 15)[0]


def calibrated(seen: Sightings, pixel: float) -> Window | None:
    """What a window says of its camera; ``pixel`` is its size in half widths. None where it is not reconstructed."""
    best = None
    for fov_deg in _GUESSES_DEG:
        lens = PRIOR.copy()
        lens[0] = -np.log(np.tan(np.deg2rad(fov_deg) / 2))
        started = reconstructed(seen, lens, pixel) or turning(seen, lens, pixel)
        if started is None:
            continue
        problem, start = started
        start, cost = problem.solved(start, BUT_FOCAL, 0.5 * pixel, 6)
        score = cost - 6.0 * len(problem.seen)
        if best is None or score < best[0]:
            best = score, problem, start
        if len(problem.seen) > 0.8 * len(seen):
            break
    if best is None:
        return None
    _, problem, start = best
    sigma = problem.spread(start, pixel)
    problem, start = problem.without_outliers(start, max(8.0 * sigma, pixel))
    for _ in range(2):
        start, cost = problem.solved(start, BUT_FOCAL, sigma, 4)
        sigma = problem.spread(start, pixel)
    start, cost = problem.solved(start, BUT_FOCAL, sigma, 4)
    start, at_end = problem.lowest(start, cost, sigma)
    for _ in range(3):
        start, _ = problem.solved(start, ALL, sigma, 10)
        problem, start = problem.without_outliers(start, max(5.0 * sigma, 0.4 * pixel))
        sigma = problem.spread(start, pixel)
    start, _ = problem.solved(start, ALL, sigma, 15)
    turns = Rotation.from_matrix(start.T_camera_world[:, :3, :3]).as_rotvec()
    turn_deg = float(np.rad2deg(np.linalg.norm(turns[:, :2], axis=1).max()))
    return Window(
        start.lens, problem.focal_sigma(start, sigma), len(problem.seen), turn_deg, at_end
    )


def joined(windows: Iterable[Window]) -> FoundCamera:
    """The camera by windows, robustly, and a prior of its focal length; the prior's alone where they say too little."""
    telling = [w for w in windows if w.sightings > _LEAST_SIGHTINGS and not w.at_end]
    values = np.array([*(window.lens[0] for window in telling), PRIOR[0]])
    own_sigmas = [np.hypot(_INFLATED * window.sigma, _FLOOR) for window in telling]
    sigmas = np.array([*own_sigmas, UNKNOWN_FX_SIGMA])
    centre = weighted_median(values, sigmas**-2)
    for _ in range(10):
        near = np.maximum(np.abs(values - centre) / sigmas, 1e-9)
        weights = np.minimum(1.0, _HUBER / near) / sigmas**2
        centre = float(weights @ values / weights.sum())
    disagree = float(weights @ (values - centre) ** 2) / max(len(telling), 1)
    sigma = float(np.hypot(np.sqrt(max(1.0, disagree) / weights.sum()), _SYSTEMATIC))
    if not telling or sigma > ROUGH:
        focal = float(np.exp(PRIOR[0]))
        return FoundCamera(focal, (0.0, 0.0), (0.0, 0.0), UNKNOWN_FX_SIGMA, 0, 0.0)
    focal, own = float(np.exp(centre)), weights[:-1]
    first, second, x, y = (own @ np.array([w.lens[1:] for w in telling]) / own.sum()).tolist()
    turn_deg = max(window.turn_deg for window in telling)
    radial = first * focal**2, second * focal**4
    return FoundCamera(focal, radial, (x, y), sigma, len(telling), turn_deg)


def _narrow(frame: Frame) -> Frame:
    """The same image, at most so wide that following its corners is quick."""
    height, width = frame.image.shape[:2]
    if width <= _WIDTH_PX:
        return frame
    size = _WIDTH_PX, round(height * _WIDTH_PX / width)
    small = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
    return Frame(frame.index, frame.stamp, np.asarray(small, np.uint8), frame.fixed)
