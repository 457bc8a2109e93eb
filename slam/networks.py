"""The trained networks behind the ``Predictor`` protocol: frames in, snippet poses and depth out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from erfsfm.inference import depth_at
from slam.frames import DepthMap, Frame, Image, SnippetPoses


class Networks(Protocol):
    """What is asked of networks by image: ``erfsfm.inference.DepthPosePredictor``, or a cache before it."""

    sources: int

    def disparity(self, image: Image) -> NDArray[np.float32]:
        """Unscaled 1/depth ``(h, w)`` of an image, at the networks' own size."""
        ...

    def poses(self, images: Sequence[Image]) -> NDArray[np.float64]:
        """``T_source_target`` ``(N, 4, 4)`` of N + 1 images in time order, the target in the middle."""
        ...


class NetworkPredictor:
    """Answers by frame what networks answer by image."""

    def __init__(self, networks: Networks) -> None:
        self._networks = networks
        self.sources = networks.sources

    def depth(self, frame: Frame) -> DepthMap:
        """Unscaled z-depth ``(H, W)`` at the image's size."""
        height, width = frame.image.shape[:2]
        return depth_at(self._networks.disparity(frame.image), height, width)

    def snippet(self, frames: Sequence[Frame]) -> SnippetPoses:
        """Poses of the sources of a snippet; the target is the middle frame."""
        T_source_target = self._networks.poses([frame.image for frame in frames])
        middle = self.sources // 2
        sources = tuple(f.index for k, f in enumerate(frames) if k != middle)
        return SnippetPoses(frames[middle].index, sources, T_source_target)
