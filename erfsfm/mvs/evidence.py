"""What neighbouring images say about the depth of an image, stacked for a network that decides (`erfsfm.mvs.fusion`).

Nothing in it has a unit: depth is relative to the median of the image, so one network serves streets and rooms.
"""

from __future__ import annotations

import numpy as np

from erfsfm.mvs.appearance import Array
from erfsfm.mvs.refine import Measurement
from erfsfm.mvs.semi_global import UNIT, Costs
from erfsfm.mvs.sweep import CHANGES, lowest

FULL_SIZE = 6  # maps at full size, four channels each, before those at half size
HALF_SIZE = 6
CHANNELS = 4 * FULL_SIZE + HALF_SIZE
CHANGE = 2  # which of the maps at full size is the measured change
_GUESS = int(np.abs(CHANGES).argmin())
_APART = 2  # samples between the least cost and the second minimum
_LEAST_INFORMATION = 1e-2
_MOST = 4.0  # of a channel


def evidence(measurement: Measurement) -> Array:
    """Channels ``(CHANNELS, h, w)`` of a measurement at half size, rounded down."""
    depth, K = measurement.depth, measurement.K
    height, width = depth.shape
    h, w = height // 2, width // 2
    nearness = np.log(np.median(depth) / depth)
    y = (np.arange(height, dtype=np.float32)[:, None] - np.float32(K[1, 2])) / np.float32(K[1, 1])
    full = (
        measurement.target.levels,
        nearness,
        measurement.change,
        measurement.fit,
        np.log(np.maximum(measurement.information, _LEAST_INFORMATION)) / 4,
        y * np.exp(-nearness - measurement.change),  # height under the camera over the median depth
    )
    half = _of_costs(measurement.costs, measurement.coarse)
    return np.concatenate([np.clip([_quartered(part, h, w) for part in full], -_MOST, _MOST).reshape(-1, h, w), half])


def _of_costs(costs: Costs, coarse: Array) -> Array:
    """Of the sweep: its best change and cost, the cost of the guess, the second minimum; the change when smoothed."""
    best = costs.argmin(axis=0).astype(np.int8)
    apart = np.abs(np.arange(len(costs), dtype=np.int8)[:, None, None] - best) > _APART
    others = np.where(apart, costs, np.int16(np.iinfo(np.int16).max))
    second = others.argmin(axis=0)
    least = np.stack([costs.min(axis=0), costs[_GUESS], np.take_along_axis(others, second[None], axis=0)[0]])
    return np.concatenate([[lowest(costs)], least / np.float32(UNIT), [CHANGES[second], coarse]]).astype(np.float32)


def _quartered(part: Array, h: int, w: int) -> Array:
    """Blocks of 2x2 pixels as four channels ``(4, h, w)``, by row, then by column."""
    blocks = part[: 2 * h, : 2 * w].astype(np.float32).reshape(h, 2, w, 2)
    return np.asarray(blocks.transpose(1, 3, 0, 2).reshape(4, h, w))
