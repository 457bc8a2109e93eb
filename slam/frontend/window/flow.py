"""Sparse optical flow between any two images, forwards and backwards, and new corners among old ones."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Grey

Pixels = NDArray[np.float32]

_CORNER_QUALITY = 0.002  # least corner strength over that of the strongest corner
_WINDOW_PX = 15, 15  # Lucas-Kanade window
_FORWARD_BACKWARD_PX = 0.7  # largest forward-backward tracking error
_LIMITS = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT
_FORWARD: dict[str, Any] = {"criteria": (_LIMITS, 15, 0.02), "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
_BACKWARD: dict[str, Any] = {"criteria": (_LIMITS, 10, 0.05), "flags": cv2.OPTFLOW_USE_INITIAL_FLOW, "maxLevel": 1}


def flow(first: Grey, second: Grey, pixels: Pixels, guesses: Pixels, levels: int) -> tuple[Pixels, NDArray[np.bool_]]:
    """Pixels ``(M, 2)`` of the first image found in the second from guesses, and which were found back ``(M,)``."""
    if not len(pixels):
        return pixels, np.zeros(0, np.bool_)
    found, forward, _ = cv2.calcOpticalFlowPyrLK(
        first, second, pixels, guesses.copy(), winSize=_WINDOW_PX, maxLevel=levels, **_FORWARD
    )
    back, backward, _ = cv2.calcOpticalFlowPyrLK(second, first, found, pixels.copy(), winSize=_WINDOW_PX, **_BACKWARD)
    height, width = second.shape
    inside = (found >= 0).all(axis=1) & (found[:, 0] <= width - 1) & (found[:, 1] <= height - 1)
    kept = inside & (forward.ravel() > 0) & (backward.ravel() > 0)
    return found, kept & (np.linalg.norm(back - pixels, axis=1) < _FORWARD_BACKWARD_PX)


def new_corners(grey: Grey, taken: Pixels, count: int, spacing_px: float) -> Pixels:
    """Up to ``count`` Shi-Tomasi corners ``(M, 2)`` at least ``spacing_px`` from each other and from taken ones."""
    if count <= 0:
        return np.zeros((0, 2), np.float32)
    mask = np.full(grey.shape, 255, np.uint8)
    for u, v in np.rint(taken).astype(int):
        cv2.circle(mask, (int(u), int(v)), round(spacing_px), 0, -1)
    found = cv2.goodFeaturesToTrack(grey, count, _CORNER_QUALITY, spacing_px, mask=mask)
    return np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)
