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
STILL_LEVELS = 1.5  # of 255; five real drives at 2.4 m/s and more never changed by less than 2
_SMALL = (104, 32)  # columns, rows: coarse enough to average noise away


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
    """Whether an image hardly differs from the last before it, by its median absolute change of grey level, ``(N,)``.

    The median is robust to traffic. The median change itself is subtracted first, as a change of exposure. The first
    frame has the result of the second.
    """
    columns, rows = _SMALL
    changes = np.full(len(recording), np.nan)
    previous: NDArray[np.float32] | None = None
    for index in range(len(recording)):
        try:
            image = cv2.cvtColor(recording.image(index, rows, columns), cv2.COLOR_RGB2GRAY).astype(
                np.float32
            )
        except DataError:
            continue  # whoever reads the snippets names it
        if previous is not None:
            change = image - previous
            changes[index] = np.median(np.abs(change - np.median(change)))
        previous = image
    changes[0] = changes[min(1, len(changes) - 1)]
    return changes < STILL_LEVELS
