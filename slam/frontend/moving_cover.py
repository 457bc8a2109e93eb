"""Something of one grey level that moves over the image, such as a windscreen wiper.

It covers a part of the scene and shows another again: a region that becomes brighter was uniform before, and one that
becomes darker is uniform now, at the same level. Both are large, and such pairs follow each other: in real drives,
where dark cars pass and shadows move, 5 of 20 images at most have one.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]

_STEP = 25  # grey levels
_LEAST_SHARE = 0.015  # of the image, each region
_SAME_LEVEL = 8.0
_UNIFORM = 6.0  # standard deviation in the neighbourhood of a pixel
_NEIGHBOURHOOD_PX = (5, 5)
_IMAGES = 20
_LEAST_OF_THEM = 10


def is_crossed(before: Grey, now: Grey) -> bool:
    """Whether something dark and uniform has another place in one of two images ``(h, w)``, about 200 pixels wide."""
    if before.shape != now.shape:
        return False
    change = now.astype(np.int16) - before
    covers, covered = _level(change < -_STEP, now), _level(change > _STEP, before)
    return covers is not None and covered is not None and abs(covers - covered) < _SAME_LEVEL


def crossings(frames: Sequence[int]) -> list[tuple[int, int]]:
    """First and last frame of every stretch where many images follow each other with something that moved over them.

    Args:
        frames: those of which `is_crossed` is true, in order.
    """
    stretches: list[tuple[int, int]] = []
    for first, last in zip(frames, frames[_LEAST_OF_THEM - 1 :]):
        if last - first >= _IMAGES:
            continue
        if stretches and first <= stretches[-1][1]:
            stretches[-1] = stretches[-1][0], last
        else:
            stretches.append((first, last))
    return stretches


def _level(changed: NDArray[np.bool_], image: Grey) -> float | None:
    """Mean grey level of the largest uniform region that changed; None where it is small."""
    if np.count_nonzero(changed) < _LEAST_SHARE * changed.size:
        return None
    values = image.astype(np.float32)
    mean = cv2.blur(values, _NEIGHBOURHOOD_PX)
    uniform = cv2.blur(values * values, _NEIGHBOURHOOD_PX) - mean * mean < _UNIFORM**2
    count, pieces, sizes, _ = cv2.connectedComponentsWithStats((changed & uniform).view(np.uint8), connectivity=4)
    if count < 2:
        return None
    largest = 1 + int(np.argmax(sizes[1:, cv2.CC_STAT_AREA]))
    if sizes[largest, cv2.CC_STAT_AREA] < _LEAST_SHARE * changed.size:
        return None
    return float(image[pieces == largest].mean())
