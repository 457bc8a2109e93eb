"""Stretches of a recording in which the camera moves; where it stands, only traffic does.

That gives a wrong depth. Stops are told by the speed of the GPS/IMU, or by image differences where
there is none. A packet or an image that cannot be read is taken for one of a moving car.
"""

from __future__ import annotations

import logging
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.readers.kitti import velocity
from erfsfm.data.recordings import Recording

logger = logging.getLogger(__name__)

STILL_M_S = 0.5  # 5 cm a frame
# shift of texture from image to image, pixels of small ones: eight real drives at 2.4 m/s and more have
# 0.049 and more, the least on a plain motorway; one that stands has 0.01, in the dark seldom 0.04
STILL_PX = 0.04
_SMALL = (104, 32)  # columns, rows: coarse enough to average noise away
_FINER = 4  # the images that they are averaged from: whole grey levels are too coarse in the dark
_TEXTURED = 0.75  # of the pixels have less texture than those that tell


def moving_parts(recording: Recording, shortest_stop: int = 1) -> list[Recording]:
    """The stretches of a recording between stops of that many frames, in order; all of it where it never stops."""
    if recording.oxts is None:
        still = _unchanged(recording)
    else:
        still = _speeds(recording.oxts, recording.start, len(recording)) < STILL_M_S
    moving = np.ones(len(recording), np.bool_)
    for start, stop in _runs(still):
        moving[start:stop] = stop - start < shortest_stop
    return [recording.part(int(start), int(stop)) for start, stop in _runs(moving)]


def _runs(chosen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Starts and ends ``(K, 2)`` of the runs of chosen frames."""
    return np.flatnonzero(np.diff(chosen.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)


@lru_cache(maxsize=1)
def _speeds(oxts: Path, start: int, frames: int) -> NDArray[np.float64]:
    """``(N,)`` in m/s, NaN where unknown; the cameras of a drive share them."""
    speeds = np.full(frames, np.nan)
    reasons = []
    for index in range(frames):
        try:
            speeds[index] = np.linalg.norm(velocity(oxts, start + index))
        except DataError as error:
            reasons.append(str(error))
    if len(reasons) == frames:
        raise DataError(reasons[0])
    if reasons:
        logger.warning(
            "%d of %d frames have no speed and are kept: %s", len(reasons), frames, reasons[0]
        )
    return speeds


def _unchanged(recording: Recording) -> NDArray[np.bool_]:
    """Whether an image hardly differs from the last before it, ``(N,)``.

    By the median absolute change where the image has most texture, over the median gradient there: that is the same in
    the dark, and a sky or a plain road says nothing but how strong the noise is, which is taken off. Medians are
    robust to traffic. The median change itself is subtracted first, as a change of exposure. The first frame has the
    result of the second.
    """
    columns, rows = _SMALL
    changes = np.full(len(recording), np.nan)
    previous: NDArray[np.float32] | None = None
    for index in range(len(recording)):
        try:
            image = recording.image(index, _FINER * rows, _FINER * columns)
        except DataError:
            continue  # whoever reads the snippets names it
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        small = cv2.resize(grey, _SMALL, interpolation=cv2.INTER_AREA)
        if previous is not None:
            change = small - previous
            slopes = (cv2.Sobel(previous, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (1, 0))
            gradient = np.hypot(*slopes)
            low, high = np.quantile(gradient, [1.0 - _TEXTURED, _TEXTURED])
            change = np.abs(change - np.median(change))
            is_textured = gradient >= high  # everywhere in a blank image
            noise, shift = np.median(change[gradient <= low]), np.median(change[is_textured])
            texture = max(float(np.median(gradient[is_textured])), 1.0)
            changes[index] = np.sqrt(max(shift**2 - noise**2, 0.0)) / texture
        previous = small
    changes[0] = changes[min(1, len(changes) - 1)]
    return changes < STILL_PX
