"""Depth refined by a trained network that reads the evidence of the neighbouring images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from onnxruntime import InferenceSession

from erfsfm.common.errors import CheckpointError
from erfsfm.common.files import read_bytes
from erfsfm.common.onnx_session import open_session
from erfsfm.mvs.appearance import Array
from erfsfm.mvs.evidence import CHANNELS, evidence
from erfsfm.mvs.refine import SIGMA_FLOOR, Measurement, RefinedDepth

FILE = "fusion.onnx"
SHIPPED = Path(__file__).parents[1] / "weights" / "fusion"
STEP = 8  # height and width of the network's input are multiples of it
_MOST_BYTES = 2**26
_MOST_SIGMA = 2.0
_THREADS = 1


class DepthFusion:
    """A network of ``erfsfm train-fusion``.

    Args:
        name: "default", or its output folder, which holds ``fusion.onnx``.

    Raises:
        CheckpointError: there is none, or it is not such a network.
    """

    def __init__(self, name: str) -> None:
        path = (SHIPPED if name == "default" else Path(name)) / FILE
        try:
            self._session: InferenceSession = open_session(read_bytes(path, _MOST_BYTES), _THREADS)
        except OSError as error:
            raise CheckpointError(f"{path} cannot be read; give an output folder of erfsfm train-fusion") from error
        except Exception as error:  # ONNX Runtime raises classes of its own
            raise CheckpointError(f"{path} is damaged, or no ONNX file: train it again") from error
        inputs = self._session.get_inputs()
        if [i.name for i in inputs] != ["evidence"] or inputs[0].shape[1] != CHANNELS:
            raise CheckpointError(
                f"{path} is not a network of erfsfm train-fusion, or of another version: train it again"
            )

    def decide(self, measurement: Measurement) -> RefinedDepth:
        """Between learned and measured depth at each pixel; the network finds by itself what moves."""
        depth, channels = measurement.depth, evidence(measurement)
        h, w = channels.shape[1:]
        padded = np.pad(channels, ((0, 0), (0, -h % STEP), (0, -w % STEP)), mode="edge")
        change, log_sigma = (
            _at_size(values[0, : 2 * h, : 2 * w], depth.shape)
            for values in self._session.run(["change", "log_sigma"], {"evidence": padded[None]})
        )
        sigma = np.hypot(np.minimum(np.exp(log_sigma), np.float32(_MOST_SIGMA)), np.float32(SIGMA_FLOOR))
        return RefinedDepth((depth * np.exp(-change)).astype(np.float32), sigma, measurement.measured)


def _at_size(values: Array, shape: tuple[int, ...]) -> Array:
    """With the last row and column again where the size is odd."""
    below, right = shape[0] - values.shape[0], shape[1] - values.shape[1]
    return np.asarray(cv2.copyMakeBorder(values, 0, below, 0, right, cv2.BORDER_REPLICATE))
