"""Detection of images that show nothing new or nothing at all, before they are measured: blank, noise, frozen.

Also of the pixels that stand still while the camera moves: bars, logos, the bonnet of the car.

Whether an image shows the scene of the one before is not asked here: tracking finds out.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Frame, Grey, Mask, slopes_of
from slam.runtime.errors import Failed

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
# pixels stand whose grey level changes by less in the mean, and that of half of the image by much
# more
_STANDING_GREY, _MOVING_GREY = 0.7, 4.0
_BRIGHT_GREY = 235.0  # the sky does not change where the camera sees white
_STANDING_IMAGES, _REMEMBERED_IMAGES = 20, 50
# largest difference of a re-encoded copy to its image, over the mean image gradient
_REPEAT_DIFFERENCE = 0.1

Verdict = Literal["new", "repeated"] | Failed
_Layer = NDArray[np.float32]


class ImageGate:
    """Classifies the images of one sequence in time order.

    Of all ``compared`` images, ``exposed`` are much brighter or darker than the one before. Those
    pixels are ``standing`` ``(h, w)`` that do not move with the others; None where there are none.
    """

    def __init__(self) -> None:
        self.compared = self.exposed = 0
        self.standing: Mask | None = None
        self._last: Frame | None = None
        self._verdict: Verdict = "new"
        self._shrunk: _Layer | None = None  # the last new image at a quarter of its size
        self._difference = 0.0  # of that from the one before
        self._change: _Layer | None = None  # of its pixels, the mean over the images that moved
        self._moved = 0

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

    def _classify(self, frame: Frame) -> Verdict:
        contrast = float(np.mean(cv2.meanStdDev(frame.image)[1]))
        if contrast < _BLANK_CONTRAST:
            # images after a dark one are not compared with those before it
            self._shrunk, self._difference = None, 0.0
            return Failed("the image is blank")
        shrunk = _shrunk(frame.grey)
        thumbnail = cv2.resize(shrunk, _THUMBNAIL, interpolation=cv2.INTER_AREA)
        if float(thumbnail.std()) < _NOISE_CONTRAST * contrast:
            return Failed("the image is noise")
        return self._compared(shrunk)

    def _compared(self, shrunk: _Layer) -> Verdict:
        """Compare an image with the last new one: its exposure, and whether it is a re-encoded copy of it.

        A copy is frozen where the camera moved just before: a camera that comes to a stop slows
        down first.
        """
        before = self._shrunk
        if before is None or before.shape != shrunk.shape:
            self._shrunk, self._difference, self._change, self._moved, self.standing = (
                shrunk,
                0.0,
                None,
                0,
                None,
            )
            return "new"
        is_exposed = (
            abs(float(np.log((np.median(shrunk) + 1.0) / (np.median(before) + 1.0))))
            > _EXPOSURE_STEP
        )
        self.compared, self.exposed = self.compared + 1, self.exposed + is_exposed
        difference = _difference(before, shrunk)
        largest = max(_REPEAT_DIFFERENCE, _COPY_OVER_MOTION * self._difference)
        if difference < min(largest, _LARGEST_COPY * _REPEAT_DIFFERENCE) and self.was_moving:
            return "repeated"
        self._shrunk, self._difference = shrunk, difference
        if self.was_moving:
            self._moved += 1
            change = np.abs(shrunk - before)
            mean = change if self._change is None else self._change
            self._change = mean + (change - mean) / np.float32(min(self._moved, _REMEMBERED_IMAGES))
            if self._moved % _STANDING_IMAGES == 0:
                self.standing = _standing(self._change, shrunk)
        return "new"


def _standing(change: _Layer, shrunk: _Layer) -> Mask | None:
    """The pixels ``(h, w)`` that hardly change while most others do, in pieces of at least three by three.

    The pixels beside these belong to them: corners there are seen with a part of both.
    """
    if np.median(change) < _MOVING_GREY:
        return None
    few = ((change < _STANDING_GREY) & (shrunk < _BRIGHT_GREY)).astype(np.uint8)
    piece = np.ones((3, 3), np.uint8)
    pieces = cv2.dilate(cv2.morphologyEx(few, cv2.MORPH_OPEN, piece), piece)
    return pieces.astype(bool) if pieces.any() else None


def _shrunk(grey: Grey) -> _Layer:
    """Without the last rows and columns that fill no pixel: whole pixels are averaged ten times as fast."""
    height, width = (max(side // _SHRINKING, 1) for side in grey.shape)
    whole = grey[: _SHRINKING * height, : _SHRINKING * width]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _difference(before: _Layer, now: _Layer) -> float:
    """Mean absolute difference over mean gradient: about the motion in pixels, brightness aside."""
    difference = now - before
    difference -= difference.mean()
    gradient = float(np.hypot(*slopes_of(before)).mean())
    return float(np.abs(difference).mean()) / max(gradient, _LEAST_GRADIENT)
