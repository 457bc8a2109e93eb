"""The predictor of a run, assembled from networks and the source of depth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from erfsfm.inference import DepthPosePredictor
from slam.config.sections import DEPTH_PLUG_INS, DepthConfig
from slam.frames import Intrinsics, Predictor
from slam.prediction.depth_folder import DepthFolder, FrameNumbers, Undistort
from slam.prediction.depth_source import DepthSource, SourcedPredictor
from slam.prediction.networks import NetworkPredictor
from slam.prediction.onnx_depth import OnnxDepth
from slam.runtime.errors import SlamError
from slam.runtime.imports import import_plug_in, plug_ins


def open_depth(
    config: DepthConfig, intrinsics: Intrinsics, numbers: FrameNumbers | None, undistort: Undistort | None = None
) -> DepthSource | None:
    """Open and check the source of depth; None where depth is that of the networks.

    Args:
        config: which source.
        intrinsics: of the images.
        numbers: of the frames; None where they are not known beforehand, as live.
        undistort: what is done with the images as they are read, for depth files of the stored ones.

    Raises:
        SlamError: the source is missing, damaged or does not fit.
    """
    kind, _, argument = config.source.partition(":")
    if kind == "network":
        return None
    if kind == "onnx":
        return OnnxDepth(config)
    if kind in plug_ins(DEPTH_PLUG_INS):
        opened: DepthSource = import_plug_in(plug_ins(DEPTH_PLUG_INS)[kind])(argument, intrinsics)
        return opened
    if numbers is None:
        raise SlamError(
            f"depth.source={config.source} needs a whole sequence, with its depth on disk: choose network or onnx:FILE "
            "for frames as they come"
        )
    return DepthFolder(config, numbers, intrinsics.width, intrinsics.height, undistort)


@dataclass(frozen=True)
class Prediction:
    """Networks, the source of depth where that is another, and both as the predictor of a run."""

    networks: DepthPosePredictor
    source: DepthSource | None
    predictor: Predictor


def open_prediction(
    weights: str | Path,
    device: str,
    depth: DepthConfig,
    intrinsics: Intrinsics,
    numbers: FrameNumbers | None = None,
    undistort: Undistort | None = None,
) -> Prediction:
    """Networks by the name of shipped weights or a training output folder, with depth as configured.

    Raises:
        SlamError: as `open_depth`.
        ErfsfmError: as ``DepthPosePredictor.from_weights``.
    """
    source = open_depth(depth, intrinsics, numbers, undistort)
    networks = DepthPosePredictor.from_weights(weights, device, "onnx")
    own = NetworkPredictor(networks, intrinsics)
    return Prediction(networks, source, own if source is None else SourcedPredictor(own, source, depth.align))
