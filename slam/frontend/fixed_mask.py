"""The part of the image that is fixed to the camera: the bonnet, a caption, dirt, a mirror, the bars of a video.

Its edges stay at the same pixels while the image of the world moves. So over many images the mean of the gradient is as
long there as gradients are in the mean, and near zero where the world passes. Edges along the motion, as kerbs and
lane markings, stay too, and run towards the middle of a vehicle's image. So only the part of a gradient that points
towards the middle is asked: an edge across the motion would have moved.

A bonnet reflects the world, whose image moves on it, and is now darker, now brighter than the road before it. But at
its edge gradients of either sign are longer than above and below, from side to side of the image. All that is between
such an edge and the border of the image belongs to it.
"""

from __future__ import annotations

import logging
import math
from itertools import accumulate

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Grey, Mask, resized_mask, shrunk, slopes_of

logger = logging.getLogger(__name__)

LEAST_IMAGES = 20  # before which nothing is said
_REMEMBERED_IMAGES = 200  # a wiper comes to rest, a sticker falls
_EVERY_FIRST, _EVERY = 2, 5  # image that is looked at, until there are enough, and then
_WIDTH_PX = 320  # of the image that is looked at, at most: captions are still seen, noise hardly
_LOCAL_PX = 3.0  # sigma of the blur that takes out what changes slowly, as the sky does
_STRONGEST = 8.0  # grey levels a pixel: one lamp must not count more than many images
_CELLS = 16, 9  # across and down
_LEAST_MOVED = 0.5  # of the columns of cells with texture, in an image that counts
_MOVED = 0.8  # difference of two images over their mean gradient, about pixels
_TEXTURE = 1.2  # least mean gradient of a cell, grey levels a pixel: noise has less
_EDGE = 0.8  # least mean gradient at an edge, grey levels a pixel
# the mean of the gradient over its mean length: at fixed edges, more where few images were seen
_FIXED, _FIXED_OF_FEW = 0.55, 4.0
_WORLD = 0.35  # and at most where the world passes
# share of world below the edge of a bonnet, which reflects it; below that of a reflection on the
# windscreen there is more
_PASSES = 0.6
_ALONG_PX = 0.7  # sigma of the blur of the mean length
# the pixels beside an edge by which it is judged, and the least length there, grey levels a pixel: on a
# road without texture lane markings are edges
_BESIDE, _LEAST_BESIDE = (np.arange(9)[:, None] % 8 == 0).view(np.uint8), 1.5
# of the length at an edge over that beside it, less one: each pixel's least and most, a path's least in the
# mean (0.23 to 0.36 at bonnets, 0.08 without after 20 images), and what a path loses where it bends
_RISES, _LEAST_RISE, _BEND = (-0.3, 0.4), 0.18, 0.1
_TOWARDS_MIDDLE = 0.5  # cosine of the angle between a gradient and the direction to the middle
_NEAR_MIDDLE = 0.06  # of the width, within which every direction may be that of the motion
_GAP = 0.025  # of the width, over which fixed edges are joined
_DEEPEST = 0.4  # of the side of the image that such an edge may hide
_LEAST_STANDING, _MOST_STANDING = 0.02, 0.6  # of the image, of which a run says something
_NEIGHBOURS = np.ones((3, 3), np.uint8)  # of a pixel: corners beside a fixed one see a part of it

_Layer = NDArray[np.float32]


class FixedMask:
    """Learns from the images of one sequence, in time order, which of their pixels are fixed to the camera.

    ``mask`` ``(h, w)`` is True there, in a small size; None before enough images have moved, where nothing is.
    """

    def __init__(self) -> None:
        self.mask: Mask | None = None
        self._seen = self._counted = 0
        self._last: _Layer | None = None  # the last image that counted
        # over the images that counted: both slopes, their length, and the slope towards the middle, also its size
        self._means: _Layer = np.zeros((5, 0, 0), np.float32)

    def follow(self, grey: Grey, given: Mask | None = None) -> None:
        """Look at some of the images ``(H, W)`` that follow each other; arguments as in `look_at`."""
        self._seen += 1
        if self._seen % (_EVERY if self._counted >= LEAST_IMAGES else _EVERY_FIRST) == 0:
            self.look_at(grey, given)

    def look_at(self, grey: Grey, given: Mask | None = None) -> None:
        """Look at an image ``(H, W)``, which counts if most of it has moved since the last one that counted.

        A mask that is ``given`` ``(H, W)`` is joined with what is found.
        """
        local = _local(grey)
        slopes = slopes_of(local)
        length = cv2.magnitude(*slopes)
        if self._last is None or self._last.shape != local.shape:
            self.mask, self._counted = None, 0
            self._means = np.zeros((5, *local.shape), np.float32)
        elif not self._has_moved(np.abs(local - self._last), length):
            return
        self._last = local
        self._counted += 1
        weight = _STRONGEST / np.maximum(length, _STRONGEST)
        across, down = _towards_middle(local.shape)
        inwards = slopes[0] * across + slopes[1] * down
        now = weight * np.stack([*slopes, length, inwards, np.abs(inwards)])
        self._means += (now - self._means) / np.float32(min(self._counted, _REMEMBERED_IMAGES))
        if self._counted % LEAST_IMAGES == 0:
            self.mask = self._found()
            if self.mask is not None and given is not None:
                self.mask |= resized_mask(given, *local.shape[::-1])

    def _has_moved(self, change: _Layer, length: _Layer) -> bool:
        """Whether most of what is not fixed has moved: a lorry that passes a waiting car is not most of it."""
        if self.mask is not None:
            change, length = (np.where(self.mask, np.float32(0), each) for each in (change, length))
        changes, textures = (
            cv2.resize(each, _CELLS, interpolation=cv2.INTER_AREA) for each in (change, length)
        )
        is_asked = textures > _TEXTURE
        has_moved = is_asked & (changes > _MOVED * textures)
        columns = is_asked.any(axis=0)
        moved_columns = 2 * has_moved.sum(axis=0) > is_asked.sum(axis=0)
        return bool(moved_columns.sum() > _LEAST_MOVED * columns.sum())

    def _found(self) -> Mask | None:
        slope_x, slope_y, length, inwards, inwards_size = self._means
        mean = np.hypot(slope_x, slope_y)
        least = _FIXED + _FIXED_OF_FEW / self._counted
        is_fixed = (mean > least * length) & (np.abs(inwards) > least * inwards_size)
        is_fixed &= (np.abs(inwards) > _TOWARDS_MIDDLE * mean) & (length > _EDGE)
        world = (mean < _WORLD * length) & (length > _EDGE)
        edges = cv2.morphologyEx(
            is_fixed.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)
        )
        gap = np.ones((round(_GAP * edges.shape[1]),) * 2, np.uint8)
        fixed = cv2.morphologyEx(edges, cv2.MORPH_CLOSE, gap).astype(np.bool_)
        for turns in range(4):
            fixed |= np.rot90(_beyond_edge(np.rot90(length, turns), np.rot90(world, turns)), -turns)
        if not fixed.any():
            return None
        return np.asarray(cv2.dilate(fixed.view(np.uint8), _NEIGHBOURS), np.bool_)


def warn_of_fixed(fixed: Mask | None) -> None:
    """Warn of a part of the image that does not show the world."""
    share = 0.0 if fixed is None else float(fixed.mean())
    if share > _LEAST_STANDING:
        logger.warning(
            "%.0f %% of the image stand still while the camera moves (bars, a logo, the bonnet): no corner, depth or "
            "road is taken from there",
            100 * share,
        )
    if share > _MOST_STANDING:
        logger.warning(
            "little of the world is left: mount the camera so that it sees more of the road, or give a mask in "
            "camera.yaml if the part was found wrongly"
        )


def _beyond_edge(length: _Layer, world: Mask) -> Mask:
    """Pixels ``(h, w)`` below an edge that reaches from side to side, in the lower part of an image.

    Where gradients have a larger mean ``length`` ``(h, w)`` than above and below. Not below the
    edge of a reflection, through which the ``world`` ``(h, w)`` is seen to pass.
    """
    first = round((1.0 - _DEEPEST) * len(length))
    along = cv2.GaussianBlur(length, (0, 0), _ALONG_PX)
    beside = cv2.dilate(along, _BESIDE, borderType=cv2.BORDER_REPLICATE)
    rise = np.clip(along / np.maximum(beside, _LEAST_BESIDE) - 1.0, *_RISES)[first:-1]
    onward, back = (np.array(list(accumulate(way, _best_sums))) for way in (rise.T, rise.T[::-1]))
    through = onward + back[::-1] - rise.T  # of the path through each pixel with the largest sum
    below = np.arange(len(length))[:, None] >= first + through.argmax(axis=1)
    is_edge = through.max() > _LEAST_RISE * rise.shape[1] and world[below].mean() < _PASSES
    return below & is_edge


def _best_sums(sums: _Layer, column: _Layer) -> _Layer:
    """Sums ``(h,)`` along the best paths to each pixel of a column, by those to the column before."""
    # the sum itself is among them, and never the largest with a bend
    bent = cv2.dilate(sums, _NEIGHBOURS).ravel() - _BEND
    return column + np.maximum(bent, sums)


def _local(grey: Grey) -> _Layer:
    """The image in a smaller size, without what changes slowly over it."""
    small = shrunk(grey, math.ceil(grey.shape[1] / _WIDTH_PX))
    return small - cv2.GaussianBlur(small, (0, 0), _LOCAL_PX)


def _towards_middle(shape: tuple[int, ...]) -> tuple[_Layer, _Layer]:
    """Unit vectors from the middle of an image ``(h, w)``, across and down; zero near it."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    u -= (shape[1] - 1) / 2
    v -= (shape[0] - 1) / 2
    radius = np.hypot(u, v)
    nearness = (radius > _NEAR_MIDDLE * shape[1]) / np.maximum(radius, 1.0)
    return u * nearness, v * nearness
