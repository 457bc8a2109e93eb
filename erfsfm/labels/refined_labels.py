"""Labels by learned depth that neighbours refine at the poses of the SLAM system.

Lengths are in heights of the camera over the road.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from erfsfm.labels.flow_labels import MIN_SNR, SKY_INVERSE_DEPTH, sky_mask
from erfsfm.mvs import refine
from erfsfm.mvs.fusion import DepthFusion
from erfsfm.mvs.views import Appearance, Array, Grey

SIGMAS = 1.645  # of the bounds: nine of ten errors lie between them
LEAST_KNOWN = 500  # pixels
_MOST_SIGMA = 0.9  # beyond which nothing is known

_fusion = lru_cache(maxsize=1)(partial(DepthFusion, "default"))  # of this process


def refined_label(
    target: Grey,
    neighbours: Sequence[Grey],
    K: NDArray[np.floating],
    T_neighbour_target: NDArray[np.float64],
    learned: Array,
) -> tuple[Array, Array]:
    """Least and most inverse depth of each pixel ``(H, W)``, in one over camera heights; 0 and infinite if unknown.

    The shipped fusion network decides between the ``learned`` inverse depth ``(H, W)``, in one over camera heights, and
    what the neighbours measure, and how sure it is. The sky is bounded from above. Else as `label`.
    """
    others = [Appearance.of(each) for each in neighbours]
    image, depth = Appearance.of(target), np.asarray(1 / learned, np.float32)
    measured = refine.measure(image, depth, others, K, T_neighbour_target)
    if measured.measured.any():  # the unit of learned depth differs from frame to frame
        depth *= np.float32(np.exp(-np.median(measured.change[measured.measured])))
        measured = refine.measure(image, depth, others, K, T_neighbour_target)
    refined = _fusion().decide(measured)
    inverse_depth, half = 1 / refined.depth, SIGMAS * refined.relative_sigma
    known = refined.relative_sigma < _MOST_SIGMA
    least = np.where(known, inverse_depth * np.exp(-half), 0)
    most = np.where(known, inverse_depth * np.exp(half), np.inf)
    sky = (inverse_depth < SKY_INVERSE_DEPTH) | sky_mask(target, (float(K[0, 2]), float(K[1, 2])))
    least[sky], most[sky] = 0, SKY_INVERSE_DEPTH
    return least.astype(np.float32), most.astype(np.float32)


def shrunk(least: Array, most: Array, factor: int) -> tuple[Array, Array]:
    """Bounds ``(H, W)`` of the inverse depth of images that are smaller by a whole factor.

    A pixel stands for a block of pixels: the bounds are as far apart as theirs, in the geometric mean, and the further
    the more these differ, which they do at edges of depth. Where a pixel of the block has no bound, it has none.
    """
    if factor == 1:
        return least, most
    both = (least > 0) & np.isfinite(most)
    with np.errstate(divide="ignore", invalid="ignore"):  # an unknown bound is 0 or infinite
        low = _in_blocks(np.log(least), factor)
        high = _in_blocks(np.log(most), factor)
        middle = _in_blocks(np.where(both, np.log(least * most) / 2, 0), factor)
    spread = np.ptp(middle, axis=-1) / 2
    both = np.isfinite(low).all(-1) & np.isfinite(high).all(-1)
    known_low = np.where(both, low.mean(-1) - spread, low.min(-1))
    known_high = np.where(both, high.mean(-1) + spread, high.max(-1))
    return np.exp(known_low).astype(np.float32), np.exp(known_high).astype(np.float32)


def _in_blocks(values: Array, factor: int) -> Array:
    """Values ``(h * factor, w * factor)`` by block of pixels: ``(h, w, factor * factor)``."""
    height = values.shape[0] // factor
    width = values.shape[1] // factor
    blocks = values.reshape(height, factor, width, factor).swapaxes(1, 2)
    return blocks.reshape(height, width, -1)


def in_camera_heights(learned: Array, measured: Array, sigma: Array) -> Array | None:
    """Inverse depth ``(H, W)`` of any unit scaled to what is measured without it; None where too little is."""
    known = measured > MIN_SNR * sigma
    if known.sum() < LEAST_KNOWN:
        return None
    return learned * np.float32(np.median(measured[known] / learned[known]))
