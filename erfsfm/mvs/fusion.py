"""Depth refined by a trained network that reads the evidence of the neighbouring images.

Nothing in it has a unit: depth is relative to the median of the image, so one network serves streets and rooms.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from onnxruntime import InferenceSession

from erfsfm.common.errors import CheckpointError
from erfsfm.common.files import read_bytes
from erfsfm.common.processes import open_session
from erfsfm.mvs.plane_sweep import CHANGES, UNIT, Costs, lowest
from erfsfm.mvs.refine import SIGMA_FLOOR, Measurement, RefinedDepth
from erfsfm.mvs.views import Array

FILE = "fusion.onnx"
SHIPPED = Path(__file__).parents[1] / "weights" / "fusion"
STEP = 8  # height and width of the network's input are multiples of it
_MOST_BYTES = 2**26
_MOST_SIGMA = 2.0
_THREADS = 1
FULL_SIZE = 6  # maps at full size, four channels each, before those at half size
HALF_SIZE = 6
CHANNELS = 4 * FULL_SIZE + HALF_SIZE
CHANGE = 2  # which of the maps at full size is the measured change
_GUESS = int(np.abs(CHANGES).argmin())
_APART = 2  # samples between the least cost and the second minimum
_LEAST_INFORMATION = 1e-2
_MOST = 4.0  # of a channel


class DepthFusion:
    """A network of ``erfsfm train-fusion``.

    Args:
        name: "default", or its output folder, which holds ``fusion.onnx``.

    Raises:
        CheckpointError: there is none, or it is not such a network.
    """

    def __init__(self, name: str) -> None:
        self.path = path = (SHIPPED if name == "default" else Path(name)) / FILE
        try:
            self._session: InferenceSession = open_session(read_bytes(path, _MOST_BYTES), _THREADS)
        except OSError as error:
            raise CheckpointError(
                f"{path} cannot be read; give an output folder of erfsfm train-fusion"
            ) from error
        except Exception as error:  # ONNX Runtime raises classes of its own
            raise CheckpointError(f"{path} is damaged, or no ONNX file: train it again") from error
        inputs = self._session.get_inputs()
        if [i.name for i in inputs] != ["evidence"] or inputs[0].shape[1] != CHANNELS:
            raise CheckpointError(
                f"{path} is no network of this version of erfsfm train-fusion: train it again"
            )

    def decide(self, measurement: Measurement) -> RefinedDepth:
        """Between learned and measured depth at each pixel; the network finds by itself what moves."""
        depth, channels = measurement.depth, evidence(measurement)
        h, w = channels.shape[1:]
        padded = np.pad(channels, ((0, 0), (0, -h % STEP), (0, -w % STEP)), mode="edge")
        odd = (
            0,
            depth.shape[0] - 2 * h,
            0,
            depth.shape[1] - 2 * w,
        )  # where a size is odd its last row comes again
        change, log_sigma = (
            cv2.copyMakeBorder(values[0, : 2 * h, : 2 * w], *odd, cv2.BORDER_REPLICATE)
            for values in self._session.run(["change", "log_sigma"], {"evidence": padded[None]})
        )
        sigma = np.hypot(
            np.minimum(np.exp(log_sigma), np.float32(_MOST_SIGMA)), np.float32(SIGMA_FLOOR)
        )
        return RefinedDepth(
            (depth * np.exp(-change)).astype(np.float32), sigma, measurement.measured
        )


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
    every_second = slice(0, 2 * h, 2), slice(0, 2 * w, 2)
    half = _of_costs(
        np.ascontiguousarray(measurement.costs[:, *every_second]), measurement.coarse[every_second]
    )
    return np.concatenate(
        [np.clip([_quartered(part, h, w) for part in full], -_MOST, _MOST).reshape(-1, h, w), half]
    )


def _of_costs(costs: Costs, coarse: Array) -> Array:
    """Of the sweep: its best change and cost, the cost of the guess, the second minimum; the change when smoothed."""
    best = costs.argmin(axis=0).astype(np.int8)
    apart = np.abs(np.arange(len(costs), dtype=np.int8)[:, None, None] - best) > _APART
    others = np.where(apart, costs, np.int16(np.iinfo(np.int16).max))
    second = others.argmin(axis=0)
    least = np.stack(
        [costs.min(axis=0), costs[_GUESS], np.take_along_axis(others, second[None], axis=0)[0]]
    )
    return np.concatenate(
        [[lowest(costs)], least / np.float32(UNIT), [CHANGES[second], coarse]]
    ).astype(np.float32)


def _quartered(part: Array, h: int, w: int) -> Array:
    """Blocks of 2x2 pixels as four channels ``(4, h, w)``, by row, then by column."""
    blocks = part[: 2 * h, : 2 * w].astype(np.float32).reshape(h, 2, w, 2)
    return blocks.transpose(1, 3, 0, 2).reshape(4, h, w)
