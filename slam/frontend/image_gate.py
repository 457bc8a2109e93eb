"""Frames that show nothing of the road are told apart before they mislead anyone: darkness, noise, repetition."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.config import GapsConfig
from slam.frames import Image
from slam.frontend.failure import MeasurementFailure
from slam.storage.serialisation import Learner

_THUMB = (32, 16)  # width, height

Verdict = Literal["new", "repeated"] | MeasurementFailure


class ImageGate(Learner):
    """Looks at the images of one sequence in time order."""

    remembers = ("_last", "_usable", "_doubtful")

    def __init__(self, config: GapsConfig) -> None:
        self._config = config
        self._last: tuple[Image, Verdict] | None = None
        self._usable: NDArray[np.float32] | None = None  # thumbs, zero mean and unit length
        self._doubtful: NDArray[np.float32] | None = None

    def check(self, image: Image) -> Verdict:
        """Whether an image ``(H, W, 3)`` shows something new, the same as the one before, or nothing usable."""
        verdict: Verdict
        if self._last is None or not np.array_equal(image, self._last[0]):
            verdict = self._judge(image)
        else:
            verdict = self._last[1] if isinstance(self._last[1], MeasurementFailure) else "repeated"
        self._last = image, verdict
        return verdict

    def _judge(self, image: Image) -> Verdict:
        contrast = float(np.mean(cv2.meanStdDev(image)[1]))
        if contrast < self._config.blank_contrast:
            # after darkness the picture before it is no measure of what comes
            self._usable = self._doubtful = None
            return MeasurementFailure("the image is blank")
        grey = cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), _THUMB, interpolation=cv2.INTER_AREA)
        thumb = grey.astype(np.float32) - np.float32(grey.mean())
        length = float(np.linalg.norm(thumb))
        if length / np.sqrt(thumb.size) < self._config.noise_contrast * contrast:
            return MeasurementFailure("the image is noise")
        thumb /= np.float32(length)
        # two pictures in a row that agree with each other are a new scene, not damage
        known = [each for each in (self._usable, self._doubtful) if each is not None]
        if known and max(float((thumb * each).sum()) for each in known) < self._config.min_correlation:
            self._doubtful = thumb
            return MeasurementFailure("the image is unlike those before it")
        self._usable, self._doubtful = thumb, None
        return "new"
