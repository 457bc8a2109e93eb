"""Corners of a keyframe found in any other image from guesses, forwards and backwards, and new corners of keyframes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.frames import Grey
from slam.frontend import sparse_flow
from slam.frontend.sparse_flow import Pixels, are_inside, lucas_kanade

_CORNER_SPACING_PX = 12.0  # least distance between corners, pixels
_CORNER_QUALITY = 0.0003  # least corner strength over that of the strongest corner of a tile
_CORNER_BLOCK_PX = 3
_WINDOW_PX = 15  # side of the Lucas-Kanade window
_FORWARD_BACKWARD_PX = 0.7  # largest forward-backward tracking error
# most iterations, and the shift in pixels below which they end
_FORWARD, _BACKWARD = (15, 0.02), (10, 0.05)
_BACKWARD_LEVELS = 1


def flow(first: Grey, second: Grey, pixels: Pixels, guesses: Pixels, levels: int) -> tuple[Pixels, NDArray[np.bool_]]:
    """Pixels ``(M, 2)`` of the first image found in the second from guesses, and which were found back ``(M,)``."""
    if not len(pixels):
        return pixels, np.zeros(0, np.bool_)
    found, forward = lucas_kanade(first, second, pixels, _WINDOW_PX, levels, _FORWARD, guesses)
    back, backward = lucas_kanade(second, first, found, _WINDOW_PX, _BACKWARD_LEVELS, _BACKWARD, pixels)
    near = np.linalg.norm(back - pixels, axis=1) < _FORWARD_BACKWARD_PX
    return found, are_inside(found, second.shape) & forward & backward & near


def new_corners(grey: Grey, taken: Pixels, count: int) -> Pixels:
    """Up to ``count`` corners ``(M, 2)`` of an image, apart from each other and from those taken."""
    return sparse_flow.new_corners(grey, taken, count, _CORNER_QUALITY, _CORNER_SPACING_PX, _CORNER_BLOCK_PX)
