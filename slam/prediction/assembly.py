"""The predictor of a run: the trained networks, with depth from elsewhere where that is wanted."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from erfsfm.inference import DepthPosePredictor, depth_at, limit_torch_threads
from slam.config.sections import DEPTH_PLUG_INS, DepthConfig
from slam.frames import DepthMap, Frame, Intrinsics, Predictor, SnippetPoses
from slam.prediction.depth_source import (
    DepthFolder,
    DepthSource,
    FrameNumbers,
    OnnxDepth,
    SourcedPredictor,
    Undistort,
)
from slam.runtime.errors import SlamError
from slam.runtime.imports import import_plug_in, plug_ins


class NetworkPredictor:
    """Depth and snippet poses of frames by the networks, for which each image is prepared once."""

    def __init__(self, networks: DepthPosePredictor, intrinsics: Intrinsics) -> None:
        self._networks, self._intrinsics = networks, intrinsics
        self._key = object()  # key of outputs kept in frames, which outlive the networks
        self.sources = networks.sources

    def executor(self) -> Executor:
        """One thread, in which torch leaves a core to the other threads."""
        return ThreadPoolExecutor(
            max_workers=1, thread_name_prefix="networks", initializer=limit_torch_threads
        )

    def depth(self, frame: Frame) -> DepthMap:
        """Unscaled z-depth ``(H, W)`` at the image's size."""
        height, width = frame.image.shape[:2]
        # (h, w) of the networks
        disparity = frame.derived(
            (self._key, "disparity"), lambda: self._networks.disparity(self._prepared(frame))
        )
        return depth_at(disparity, height, width)

    def snippet(self, frames: Sequence[Frame]) -> SnippetPoses:
        """Poses of the sources of a snippet; the target is the middle frame."""
        T_source_target = self._networks.poses(
            [self._prepared(frame) for frame in frames], self._intrinsics
        )
        middle = self.sources // 2
        sources = tuple(f.index for k, f in enumerate(frames) if k != middle)
        return SnippetPoses(frames[middle].index, sources, T_source_target)

    def _prepared(self, frame: Frame) -> Any:
        return frame.derived((self._key, "prepared"), lambda: self._networks.prepare(frame.image))


def open_depth(
    config: DepthConfig,
    intrinsics: Intrinsics,
    numbers: FrameNumbers | None,
    undistort: Undistort | None = None,
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
    if kind in ("npy", "png"):
        if numbers is None:
            raise SlamError(
                f"depth.source={config.source} needs a whole sequence, with its depth on disk: choose network or "
                "onnx:FILE for frames as they come"
            )
        return DepthFolder(config, numbers, intrinsics.width, intrinsics.height, undistort)
    if kind == "onnx":
        return OnnxDepth(config)
    opened: DepthSource = import_plug_in(plug_ins(DEPTH_PLUG_INS)[kind])(argument, intrinsics)
    return opened


def open_prediction(
    weights: str | Path,
    device: str,
    depth: DepthConfig,
    intrinsics: Intrinsics,
    numbers: FrameNumbers | None = None,
    undistort: Undistort | None = None,
) -> tuple[Predictor, DepthPosePredictor, DepthSource | None]:
    """Networks by the name of shipped weights or a training output folder, with depth as configured.

    Args:
        weights: the name of shipped weights, or a training output folder.
        device: auto, cpu or cuda.
        depth: which source of depth.
        intrinsics: of the images.
        numbers: of the frames; None where they are not known beforehand, as live.
        undistort: what is done with the images as they are read, for depth files of the stored
            ones.

    Returns:
        The predictor of a run, its networks, and the source of its depth where that is another.

    Raises:
        SlamError: as `open_depth`.
        ErfsfmError: as ``DepthPosePredictor.from_weights``.
    """
    source = open_depth(depth, intrinsics, numbers, undistort)
    networks = DepthPosePredictor.from_weights(weights, device, "onnx")
    own = NetworkPredictor(networks, intrinsics)
    predictor = own if source is None else SourcedPredictor(own, source, depth.align)
    return predictor, networks, source
