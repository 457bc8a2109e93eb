"""The part of the image that is fixed to the camera: the bonnet, a caption, dirt, a mirror, the bars of a video.

Its edges stay at the same pixels while the image of the world moves. So over many images the mean of the gradient is as
long there as gradients are in the mean, and near zero where the world passes. Edges along the motion, as kerbs and
lane markings, stay too, and run towards the middle of a vehicle's image. So only the part of a gradient that points
towards the middle is asked: an edge across the motion would have moved.

A bonnet reflects the world, whose image moves on it. So all that is between a broad fixed edge and the border of the
image belongs to it.
"""

from __future__ import annotations

import logging
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Grey, Mask, shrunk, slopes_of
from slam.geometry.robust import running_median

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
_SMOOTH = 0.04  # of the width, over which the outline of what is hidden is smoothed
_TOWARDS_MIDDLE = 0.5  # cosine of the angle between a gradient and the direction to the middle
_NEAR_MIDDLE = 0.06  # of the width, within which every direction may be that of the motion
_GAP = 0.025  # of the width, over which fixed edges are joined
# least width of an edge that hides what is beyond it, of the side of the image: of a bonnet below, and
# of bars on the right, above and on the left
_BROAD = 0.18, 0.8, 0.8, 0.8
_DEEPEST = 0.4  # of the side of the image that such an edge may hide
_CHANGED = 0.002  # of the image: a mask that changes by less stays
_MARGIN = np.ones((3, 3), np.uint8)  # corners beside a fixed pixel see a part of it

_Layer = NDArray[np.float32]


logger = logging.getLogger(__name__)

_LEAST_STANDING, _MOST_STANDING = 0.02, 0.6  # of the image, of which a run says something


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

    def follow(self, grey: Grey) -> None:
        """Look at some of the images ``(H, W)`` that follow each other."""
        self._seen += 1
        if self._seen % (_EVERY if self._counted >= LEAST_IMAGES else _EVERY_FIRST) == 0:
            self.look_at(grey)

    def look_at(self, grey: Grey) -> None:
        """Look at an image ``(H, W)``, which counts if most of it has moved since the last one that counted."""
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
        if self._counted >= LEAST_IMAGES:
            found = self._found()
            # whoever prepares something for a mask keeps it for as long as the mask is the same
            if found is None or self.mask is None or (found != self.mask).mean() > _CHANGED:
                self.mask = found

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
        gap = round(_GAP * edges.shape[1])
        joined = cv2.morphologyEx(
            np.pad(edges, gap), cv2.MORPH_CLOSE, np.ones((gap, gap), np.uint8)
        )[gap:-gap, gap:-gap]
        fixed = joined.astype(np.bool_)
        for turns, least_width in enumerate(_BROAD):
            turned = np.rot90(joined, turns), np.rot90(world, turns)
            fixed |= np.rot90(_below_broad_edges(*turned, least_width), -turns)
        if not fixed.any():
            return None
        return np.asarray(cv2.dilate(fixed.view(np.uint8), _MARGIN), np.bool_)


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


def _below_broad_edges(edges: NDArray[np.uint8], world: Mask, least_width: float) -> Mask:
    """Pixels ``(h, w)`` below broad fixed edges in the lower part of an image, down to the border.

    Not below those of a reflection, through which the ``world`` ``(h, w)`` is seen to pass.
    """
    _, parts, stats, _ = cv2.connectedComponentsWithStats(np.ascontiguousarray(edges))
    is_broad = stats[:, cv2.CC_STAT_WIDTH] > least_width * edges.shape[1]
    is_broad[0] = False  # what is no edge
    below = is_broad[parts]
    below[: round((1.0 - _DEEPEST) * len(below))] = False
    rows = np.arange(len(below), 0, -1)
    passes = np.cumsum(world[::-1], axis=0)[::-1] / rows[:, None]
    below &= passes < _PASSES
    columns = np.flatnonzero(below.any(axis=0))
    if len(columns):
        # a bonnet reaches from side to side, also where its edge is now darker, now brighter than
        # the road
        span = np.arange(edges.shape[1])
        top = np.interp(span, columns, below.argmax(axis=0)[columns])
        top = running_median(top, 2 * round(_SMOOTH * edges.shape[1]) + 1)
        is_hidden = passes[top.astype(np.intp), span] < _PASSES
        is_hidden[columns[0] : columns[-1] + 1] = True
        below = is_hidden & (np.arange(len(edges))[:, None] >= top)
    return np.asarray(below)


def _local(grey: Grey) -> _Layer:
    """The image in a smaller size, without what changes slowly over it."""
    small = shrunk(grey, math.ceil(grey.shape[1] / _WIDTH_PX))
    return np.asarray(small - cv2.GaussianBlur(small, (0, 0), _LOCAL_PX), np.float32)


def _towards_middle(shape: tuple[int, ...]) -> tuple[_Layer, _Layer]:
    """Unit vectors from the middle of an image ``(h, w)``, across and down; zero near it."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    u -= (shape[1] - 1) / 2
    v -= (shape[0] - 1) / 2
    radius = np.hypot(u, v)
    nearness = (radius > _NEAR_MIDDLE * shape[1]) / np.maximum(radius, 1.0)
    return u * nearness, v * nearness
