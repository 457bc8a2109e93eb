"""Files of labels in a prepared folder: bounds of each pixel's inverse depth as a small picture.

A pixel of the WebP has the code of its value and its kind: which bounds it has, and how far they are
apart. Bounds are rounded by a third of a sigma on average.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SMALLEST = 0.002  # inverse depth of code 0, one over camera heights: 800 m; code 255 is 0.7 m
STEP = 0.0275  # of the logarithm of the inverse depth between codes
LEAST_SIGMA = 0.01  # of the logarithm, of the first kind of measured pixel
_UNKNOWN = 0  # kinds of pixels
_AT_LEAST = 1
_AT_MOST = 2
_MEASURED = 3  # each further kind has twice the sigma
_WIDEST = 8
_LOSSLESS = [cv2.IMWRITE_WEBP_QUALITY, 101]

Bound = NDArray[np.float16]


def encode(least: NDArray[np.floating], most: NDArray[np.floating]) -> bytes:
    """The file of a label with these bounds, ``(H, W)`` each: 0 and infinite where unknown."""
    has_least, has_most = least > 0, np.isfinite(most)
    measured = has_least & has_most
    known = has_least | has_most
    low = np.log(np.where(has_least, least, np.where(known, most, 1)).astype(np.float32))
    high = np.log(np.where(has_most, most, np.where(known, least, 1)).astype(np.float32))
    sigma = np.maximum((high - low) / 2, LEAST_SIGMA)
    doublings = np.clip(np.rint(np.log2(sigma / LEAST_SIGMA)), 0, _WIDEST)
    one_sided = np.where(has_least, _AT_LEAST, np.where(has_most, _AT_MOST, _UNKNOWN))
    kind = np.where(measured, _MEASURED + doublings, one_sided)
    steps = np.where(measured, np.maximum(np.floor(LEAST_SIGMA * 2**doublings / STEP), 1), 1)
    code = (low + high - 2 * np.log(SMALLEST)) / (2 * STEP)
    code = np.clip(np.rint(code / steps) * steps, 0, 255)
    # an unknown pixel has the code of the known one left of it: small when compressed
    known_before = np.maximum.accumulate(np.where(known, np.arange(least.shape[1]), 0), axis=1)
    picture = np.zeros((*least.shape, 3), np.uint8)
    picture[..., 0], picture[..., 1] = (
        kind,
        np.take_along_axis(code.astype(np.uint8), known_before, axis=1),
    )
    return bytes(cv2.imencode(".webp", picture, _LOSSLESS)[1])


def decode(data: bytes) -> tuple[Bound, Bound]:
    """Least and most inverse depth ``(H, W)`` of the bytes of a file.

    Raises:
        ValueError: they are no picture.
    """
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if picture is None:
        raise ValueError("it is no picture")
    kinds = np.arange(256)
    measured, codes = kinds >= _MEASURED, np.arange(256)
    sigma = np.where(measured, LEAST_SIGMA * 2.0 ** np.clip(kinds - _MEASURED, 0, _WIDEST), 0)
    value = SMALLEST * np.exp(STEP * codes)
    bounded_below, bounded_above = measured | (kinds == _AT_LEAST), measured | (kinds == _AT_MOST)
    ratio_least = np.where(bounded_below, np.exp(-sigma), 0).astype(np.float32)
    ratio_most = np.where(bounded_above, np.exp(sigma), np.inf).astype(np.float32)
    kind, middle = picture[..., 0], value.astype(np.float32)[picture[..., 1]]
    return (middle * ratio_least[kind]).astype(np.float16), (middle * ratio_most[kind]).astype(
        np.float16
    )
