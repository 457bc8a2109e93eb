"""Corners of an image and pyramidal Lucas-Kanade: what the tracking of steps and that of keyframes share."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Grey, Mask, resized_mask

Pixels = NDArray[np.float32]
_LIMITS = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT
# least eigenvalue of a window's gradients: a tenth of what OpenCV wants, for plain walls
_LEAST_TEXTURE = 1e-5
_TILES = 3, 4  # down and across: corners are spread over them


def lucas_kanade(
    first: Grey,
    second: Grey,
    pixels: Pixels,
    side: int,
    levels: int,
    limits: tuple[int, float],
    guesses: Pixels | None = None,
) -> tuple[Pixels, NDArray[np.bool_]]:
    """Pixels ``(M, 2)`` of the first image found in the second, and which of them were found ``(M,)``.

    Args:
        first: ``(H, W)``.
        second: of the same size.
        pixels: ``(M, 2)``, at least one.
        side: of the window, pixels.
        levels: of the image pyramid above the full image.
        limits: most iterations, and the shift in pixels below which they end.
        guesses: where the search begins ``(M, 2)``; None is at the pixels themselves.
    """
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        pixels.reshape(-1, 1, 2),
        None if guesses is None else guesses.reshape(-1, 1, 2).copy(),
        winSize=(side, side),
        maxLevel=levels,
        criteria=(_LIMITS, *limits),
        flags=0 if guesses is None else cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_LEAST_TEXTURE,
    )
    return moved.reshape(-1, 2), status.ravel().astype(bool)


def are_inside(pixels: Pixels, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which pixels ``(M, 2)`` lie in an image ``(H, W)``."""
    return np.asarray((pixels >= 0).all(axis=1) & (pixels <= [shape[1] - 1, shape[0] - 1]).all(axis=1))


def new_corners(
    grey: Grey,
    taken: Pixels,
    count: int,
    quality: float,
    spacing_px: float,
    block_px: int,
    hidden: Mask | None = None,
) -> Pixels:
    """Up to ``count`` Shi-Tomasi corners ``(M, 2)``, apart from each other and from those taken.

    All tiles of the image get equally many for as long as they have some, those that are taken among them: one thing
    that is all texture would have them all, be it the world or not.

    Args:
        grey: ``(H, W)``.
        taken: corners ``(K, 2)`` in the image.
        count: of new corners.
        quality: least strength of a corner over that of the strongest one of its tile.
        spacing_px: least distance between corners, pixels.
        block_px: side of the surroundings by which a corner is judged, pixels.
        hidden: where no corner is wanted ``(h, w)``, in any size.
    """
    if count <= 0:
        return np.zeros((0, 2), np.float32)
    free = _away_from(taken, int(spacing_px), grey.shape)
    if hidden is not None:
        free[resized_mask(hidden, *grey.shape[::-1])] = 0
    found, ranks = [np.zeros((0, 2), np.float32)], [np.zeros(0, np.int64)]
    for top, bottom in pairwise(np.linspace(0, grey.shape[0], _TILES[0] + 1).astype(int)):
        for left, right in pairwise(np.linspace(0, grey.shape[1], _TILES[1] + 1).astype(int)):
            tile, mask = grey[top:bottom, left:right], np.ascontiguousarray(free[top:bottom, left:right])
            corners = cv2.goodFeaturesToTrack(tile, count, quality, spacing_px, mask=mask, blockSize=block_px)
            if corners is not None:
                before = np.count_nonzero(((taken >= (left, top)) & (taken < (right, bottom))).all(axis=1))
                found.append(corners.reshape(-1, 2) + np.array([left, top], np.float32))
                ranks.append(before + np.arange(len(corners)))
    order = np.argsort(np.concatenate(ranks), kind="stable")[:count]
    return np.asarray(np.concatenate(found)[order])


def _away_from(pixels: Pixels, radius: int, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """A mask ``(H, W)``, zero within ``radius`` of pixels ``(M, 2)`` inside of it."""
    height, width = shape[0] + 2 * radius, shape[1] + 2 * radius
    disc = np.zeros((2 * radius + 1,) * 2, np.uint8)
    rows, columns = np.nonzero(cv2.circle(disc, (radius, radius), radius, 1, -1))
    u, v = np.rint(pixels).astype(np.int64).T
    mask = np.full(height * width, 255, np.uint8)
    mask[np.add.outer(v * width + u, rows * width + columns)] = 0
    return mask.reshape(height, width)[radius : height - radius, radius : width - radius]
