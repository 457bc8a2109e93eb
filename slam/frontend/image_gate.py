"""Rejection of unusable images before they are measured: blank, noise, upside down, mirrored, frozen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Frame
from slam.frontend.failure import MeasurementFailure
from slam.frontend.moving_cover import is_crossed
from slam.storage.cache import GetOrCompute, without_cache

_THUMBNAIL = (32, 16)  # width, height
_SHRINKING = 4  # averages out compression noise
_LEAST_GRADIENT = 1e-3
# an image is frozen if the motion before it was larger than this times the usual difference of a copy
_MOVING = 3.0
# copies of dark or blurred images differ by more: up to this ratio of the motion before, and twice the usual difference
_COPY_OVER_MOTION = 0.25
_LARGEST_COPY = 2.0
_LEAST_FLIPPED_CORRELATION = 0.3
# of the median grey level from an image to the next, in logarithms
_EXPOSURE_STEP = 0.1
# corners followed from the last image to a flipped one: a least share, and so many times those without flipping
_WIDTH_OF_TRACKING = 208
_CORNERS = 100
_LEAST_TRACKED = 0.25
_TRACKED_OVER_UNFLIPPED = 2.0
_FLIPS = {
    "upside down": (slice(None, None, -1), slice(None, None, -1)),
    "mirrored": (slice(None), slice(None, None, -1)),
}

Verdict = Literal["new", "repeated"] | MeasurementFailure
_Layer = NDArray[np.float32]
_Grey = NDArray[np.uint8]
_BLANK_CONTRAST = 3.0  # standard deviation of grey levels below which a frame is blank
_NOISE_CONTRAST = 0.3  # contrast after blurring over contrast before, below which a frame is noise
_MIN_CORRELATION = 0.2  # least correlation with the frames before
_REPEAT_DIFFERENCE = 0.1  # largest difference of a re-encoded copy to its image, over the mean image gradient


@dataclass(frozen=True)
class GateState:
    """State of the gate: what the next image is compared with.

    ``last`` frame and its ``verdict``; ``shrunk``, the last new image at a quarter of its size, and its ``difference``
    from the one before; ``usable`` and ``doubtful`` thumbnails, zero mean and unit length; ``tracked``, the image of
    ``usable`` at a smaller size, turned the right way; ``flip``, how the image before was flipped;
    of all ``compared`` images, ``exposed`` are much brighter or darker than the one before, and frames ``crossed`` have
    something before the scene that moves.
    """

    last: Frame | None = None
    verdict: Verdict = "new"
    shrunk: _Layer | None = None
    difference: float = 0.0
    usable: _Layer | None = None
    doubtful: _Layer | None = None
    tracked: _Grey | None = None
    flip: str | None = None
    compared: int = 0
    exposed: int = 0
    crossed: tuple[int, ...] = ()


class ImageGate:
    """Classifies the images of one sequence in time order."""

    def __init__(self, state: GateState | None = None, get_or_compute: GetOrCompute = without_cache) -> None:
        self._get_or_compute = get_or_compute
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
            state = self._state
            self._state = GateState(compared=state.compared, exposed=state.exposed, crossed=state.crossed)
            return MeasurementFailure("the image is blank")
        thumbnail = cv2.resize(frame.grey, _THUMBNAIL, interpolation=cv2.INTER_AREA)
        thumbnail = thumbnail.astype(np.float32) - np.float32(thumbnail.mean())
        length = float(np.linalg.norm(thumbnail))
        if length / np.sqrt(thumbnail.size) < _NOISE_CONTRAST * contrast:
            return MeasurementFailure("the image is noise")
        thumbnail /= np.float32(length)
        small = _reduced(frame.grey)
        failure = self._scene_failure(thumbnail, small)
        if failure is not None:
            return failure
        self._compare_with_last(frame.index, small)
        self._state = replace(self._state, usable=thumbnail, doubtful=None, tracked=small, flip=None)
        return "repeated" if self._is_copy(frame) else "new"

    def _compare_with_last(self, index: int, small: _Grey) -> None:
        """Count a change of exposure, and something that moves over the image."""
        state = self._state
        if state.tracked is not None:
            before, now = np.median(state.tracked), np.median(small)
            exposed = abs(float(np.log((now + 1.0) / (before + 1.0)))) > _EXPOSURE_STEP
            crossed = (*state.crossed, index) if is_crossed(state.tracked, small) else state.crossed
            exposed_now = state.exposed + exposed
            self._state = replace(state, compared=state.compared + 1, exposed=exposed_now, crossed=crossed)

    def _scene_failure(self, thumbnail: _Layer, small: _Grey) -> MeasurementFailure | None:
        state, flip = self._state, self._flip_of(thumbnail, small)
        if flip is not None:
            turned, tracked = np.ascontiguousarray(thumbnail[_FLIPS[flip]]), np.ascontiguousarray(small[_FLIPS[flip]])
            self._state = replace(state, usable=turned, doubtful=None, tracked=tracked, flip=flip)
            return MeasurementFailure(f"the image is {flip}")
        known = [each for each in (state.usable, state.doubtful) if each is not None]
        doubt = bool(known) and max(float((thumbnail * each).sum()) for each in known) < _MIN_CORRELATION
        # after flipped images correlation is not enough; two such images in a row are a new scene, not damage
        if doubt or (
            state.flip and state.doubtful is None and self._tracked_share(state.tracked, small) < _LEAST_TRACKED
        ):
            self._state = replace(state, doubtful=thumbnail)
            return MeasurementFailure("the image does not correlate with those before it")
        return None

    def _flip_of(self, thumbnail: _Layer, small: _Grey) -> str | None:
        """How the image is flipped, or None: corners of the last image are found once it is flipped back.

        Correlation alone is not enough: in a street or a turn the flipped image may correlate better than the true one.
        """
        usable, before = self._state.usable, self._state.tracked
        if usable is None:
            return None
        for name, flip in _FLIPS.items():
            if float((thumbnail[flip] * usable).sum()) < _LEAST_FLIPPED_CORRELATION:
                continue
            tracked = self._tracked_share(before, np.ascontiguousarray(small[flip]))
            if tracked > max(_LEAST_TRACKED, _TRACKED_OVER_UNFLIPPED * self._tracked_share(before, small)):
                return name
        return None

    def _tracked_share(self, before: _Grey | None, now: _Grey) -> float:
        """Share of corners that are followed to the other image and back to where they were."""
        if before is None or before.shape != now.shape:
            return 0.0
        (share,) = self._get_or_compute("share of corners", (before, now), lambda: (_followed(before, now),))
        return float(share[0])

    def _is_copy(self, frame: Frame) -> bool:
        """Whether the image is a re-encoded copy of the last new one, although the camera moved just before.

        A camera that comes to a stop slows down first; a video that freezes does not.
        """
        height, width = (max(side // _SHRINKING, 1) for side in frame.grey.shape)
        shrunk = cv2.resize(frame.grey, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
        before, limit, motion = self._state.shrunk, _REPEAT_DIFFERENCE, self._state.difference
        if before is None or before.shape != shrunk.shape:
            self._state = replace(self._state, shrunk=shrunk, difference=0.0)
            return False
        difference = _difference(before, shrunk)
        largest = min(max(limit, _COPY_OVER_MOTION * motion), _LARGEST_COPY * limit)
        if difference < largest and self.was_moving:
            return True
        self._state = replace(self._state, shrunk=shrunk, difference=difference)
        return False


def _reduced(grey: _Grey) -> _Grey:
    height, width = grey.shape
    scale = min(_WIDTH_OF_TRACKING / width, 1.0)
    size = max(round(scale * width), 1), max(round(scale * height), 1)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)


def _followed(before: _Grey, now: _Grey) -> NDArray[np.float64]:
    """The share ``(1,)`` of corners that are followed there and back."""
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.01, 5)
    if corners is None:
        return np.zeros(1)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, None, winSize=(9, 9))
    back, found_again, _ = cv2.calcOpticalFlowPyrLK(now, before, moved, None, winSize=(9, 9))
    returned = np.linalg.norm(back - corners, axis=-1) < 0.5
    return np.array([(returned & (found == 1) & (found_again == 1)).mean()])


def _difference(before: _Layer, now: _Layer) -> float:
    """Mean absolute difference over mean gradient: about the motion in pixels, brightness aside."""
    difference = now - before
    difference -= difference.mean()
    slopes = [cv2.Sobel(before, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8) for dx in (1, 0)]
    gradient = float(np.hypot(*slopes).mean())
    return float(np.abs(difference).mean()) / max(gradient, _LEAST_GRADIENT)
