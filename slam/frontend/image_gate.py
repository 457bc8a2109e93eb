"""Detection of images that show nothing new or nothing at all, before they are measured: blank, noise, frozen.

Whether an image shows the scene of the one before is not asked here: tracking finds out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Frame, Grey
from slam.frontend.failure import MeasurementFailure

_THUMBNAIL = (32, 16)  # width, height
_SHRINKING = 4  # averages out compression noise
_LEAST_GRADIENT = 1e-3
# an image is frozen if the motion before it was larger than this times the usual difference of a copy
_MOVING = 3.0
# copies of dark or blurred images differ by more: up to this ratio of the motion before, and twice the usual difference
_COPY_OVER_MOTION = 0.25
_LARGEST_COPY = 2.0
# of the median grey level from an image to the next, in logarithms
_EXPOSURE_STEP = 0.1
_BLANK_CONTRAST = 3.0  # standard deviation of grey levels below which a frame is blank
_NOISE_CONTRAST = 0.3  # contrast after blurring over contrast before, below which a frame is noise
_REPEAT_DIFFERENCE = 0.1  # largest difference of a re-encoded copy to its image, over the mean image gradient

Verdict = Literal["new", "repeated"] | MeasurementFailure
_Layer = NDArray[np.float32]


@dataclass(frozen=True)
class GateState:
    """State of the gate: what the next image is compared with.

    ``last`` frame and its ``verdict``; ``shrunk``, the last new image at a quarter of its size, and its ``difference``
    from the one before; of all ``compared`` images, ``exposed`` are much brighter or darker than the one before.
    """

    last: Frame | None = None
    verdict: Verdict = "new"
    shrunk: _Layer | None = None
    difference: float = 0.0
    compared: int = 0
    exposed: int = 0


class ImageGate:
    """Classifies the images of one sequence in time order."""

    def __init__(self, state: GateState | None = None) -> None:
        self._state = state or GateState()

    def state(self) -> GateState:
        """The state to resume from."""
        return self._state

    @property
    def was_moving(self) -> bool:
        """Whether the camera moved between the last two new images."""
        return self._state.difference > _MOVING * _REPEAT_DIFFERENCE

    def check(self, frame: Frame) -> Verdict:
        """Whether an image shows something new, repeats the one before (also after compression), or is unusable."""
        state = self._state
        if state.last is not None and np.array_equal(frame.image, state.last.image):
            verdict: Verdict = state.verdict if isinstance(state.verdict, MeasurementFailure) else "repeated"
        else:
            verdict = self._classify(frame)
        self._state = replace(self._state, last=frame, verdict=verdict)
        return verdict

    def _classify(self, frame: Frame) -> Verdict:
        contrast = float(np.mean(cv2.meanStdDev(frame.image)[1]))
        if contrast < _BLANK_CONTRAST:
            # images after a dark one are not compared with those before it
            self._state = GateState(compared=self._state.compared, exposed=self._state.exposed)
            return MeasurementFailure("the image is blank")
        thumbnail = cv2.resize(frame.grey, _THUMBNAIL, interpolation=cv2.INTER_AREA)
        if float(thumbnail.std()) < _NOISE_CONTRAST * contrast:
            return MeasurementFailure("the image is noise")
        return self._compared(_shrunk(frame.grey))

    def _compared(self, shrunk: _Layer) -> Verdict:
        """Compare an image with the last new one: its exposure, and whether it is a re-encoded copy of it.

        A copy is frozen where the camera moved just before: a camera that comes to a stop slows down first.
        """
        state, before = self._state, self._state.shrunk
        if before is None or before.shape != shrunk.shape:
            self._state = replace(state, shrunk=shrunk, difference=0.0)
            return "new"
        is_exposed = abs(float(np.log((np.median(shrunk) + 1.0) / (np.median(before) + 1.0)))) > _EXPOSURE_STEP
        self._state = replace(state, compared=state.compared + 1, exposed=state.exposed + is_exposed)
        difference = _difference(before, shrunk)
        largest = max(_REPEAT_DIFFERENCE, _COPY_OVER_MOTION * state.difference)
        if difference < min(largest, _LARGEST_COPY * _REPEAT_DIFFERENCE) and self.was_moving:
            return "repeated"
        self._state = replace(self._state, shrunk=shrunk, difference=difference)
        return "new"


def _shrunk(grey: Grey) -> _Layer:
    height, width = (max(side // _SHRINKING, 1) for side in grey.shape)
    return np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _difference(before: _Layer, now: _Layer) -> float:
    """Mean absolute difference over mean gradient: about the motion in pixels, brightness aside."""
    difference = now - before
    difference -= difference.mean()
    slopes = [cv2.Sobel(before, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8) for dx in (1, 0)]
    gradient = float(np.hypot(*slopes).mean())
    return float(np.abs(difference).mean()) / max(gradient, _LEAST_GRADIENT)
