"""Detection of images that show nothing new or nothing at all, before they are measured: blank, noise, frozen.

Whether an image shows the scene of the one before is not asked here: tracking finds out.
"""

from __future__ import annotations

import logging
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Frame, shrunk, slopes_of
from slam.runtime.errors import Failed

logger = logging.getLogger(__name__)

_THUMBNAIL = (32, 16)  # width, height
_SHRINKING = 4  # averages out compression noise
_LEAST_GRADIENT = 1e-3
# an image is frozen if the motion before it was larger than this times the usual difference of a
# copy
_MOVING = 3.0
# copies of dark or blurred images differ by more: up to this ratio of the motion before, and twice
# the usual difference
_COPY_OVER_MOTION = 0.25
_LARGEST_COPY = 2.0
# of the median grey level from an image to the next, in logarithms
_EXPOSURE_STEP = 0.1
_BLANK_CONTRAST = 3.0  # standard deviation of grey levels below which a frame is blank
_NOISE_CONTRAST = 0.3  # contrast after blurring over contrast before, below which a frame is noise
# of the compared images; real drives with automatic exposure have 0.13 at ten frames a second and
# 0.51 at two
_ROLLING_EXPOSURE = 0.6
_LEAST_COMPARED = 30
# largest difference of a re-encoded copy to its image, over the mean image gradient
_REPEAT_DIFFERENCE = 0.1

Verdict = Literal["new", "repeated"] | Failed
_Layer = NDArray[np.float32]


class ImageGate:
    """Classifies the images of one sequence in time order.

    Of all ``compared`` images, ``exposed`` are much brighter or darker than the one before.
    """

    def __init__(self) -> None:
        self.compared = self.exposed = 0
        self._last: Frame | None = None
        self._verdict: Verdict = "new"
        self._shrunk: _Layer | None = None  # the last new image at a quarter of its size
        self._difference = 0.0  # of that from the one before

    @property
    def was_moving(self) -> bool:
        """Whether the camera moved between the last two new images."""
        return self._difference > _MOVING * _REPEAT_DIFFERENCE

    def check(self, frame: Frame) -> Verdict:
        """Whether an image shows something new, repeats the one before (also after compression), or is unusable."""
        if self._last is None or not np.array_equal(frame.image, self._last.image):
            self._verdict = self._classify(frame)
        elif not isinstance(self._verdict, Failed):
            self._verdict = "repeated"
        self._last = frame
        return self._verdict

    def warn(self) -> None:
        """Warn of an exposure that rolls."""
        if self.compared >= _LEAST_COMPARED and self.exposed > _ROLLING_EXPOSURE * self.compared:
            logger.warning(
                "the exposure rolls: %d of %d images are more than a tenth brighter or darker than the one before; fix "
                "the exposure, or its flicker under lamps",
                self.exposed,
                self.compared,
            )

    def _classify(self, frame: Frame) -> Verdict:
        contrast = float(np.mean(cv2.meanStdDev(frame.image)[1]))
        if contrast < _BLANK_CONTRAST:
            # images after a dark one are not compared with those before it
            self._shrunk, self._difference = None, 0.0
            return Failed("the image is blank")
        small = shrunk(frame.grey, _SHRINKING)
        thumbnail = cv2.resize(small, _THUMBNAIL, interpolation=cv2.INTER_AREA)
        if float(thumbnail.std()) < _NOISE_CONTRAST * contrast:
            return Failed("the image is noise")
        return self._compared(small)

    def _compared(self, small: _Layer) -> Verdict:
        """Compare an image with the last new one: its exposure, and whether it is a re-encoded copy of it.

        A copy is frozen where the camera moved just before: a camera that comes to a stop slows
        down first.
        """
        before = self._shrunk
        if before is None or before.shape != small.shape:
            self._shrunk, self._difference = small, 0.0
            return "new"
        is_exposed = (
            abs(float(np.log((np.median(small) + 1.0) / (np.median(before) + 1.0))))
            > _EXPOSURE_STEP
        )
        self.compared, self.exposed = self.compared + 1, self.exposed + is_exposed
        difference = _difference(before, small)
        largest = max(_REPEAT_DIFFERENCE, _COPY_OVER_MOTION * self._difference)
        if difference < min(largest, _LARGEST_COPY * _REPEAT_DIFFERENCE) and self.was_moving:
            return "repeated"
        self._shrunk, self._difference = small, difference
        return "new"


def _difference(before: _Layer, now: _Layer) -> float:
    """Mean absolute difference over mean gradient: about the motion in pixels, brightness aside."""
    difference = now - before
    difference -= difference.mean()
    gradient = float(np.hypot(*slopes_of(before)).mean())
    return float(np.abs(difference).mean()) / max(gradient, _LEAST_GRADIENT)
