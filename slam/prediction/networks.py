"""The trained networks behind the ``Predictor`` protocol: frames in, snippet poses and depth out."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from erfsfm.inference import depth_at
from erfsfm.photometric_residual import PhotometricResidual
from slam.frames import DepthMap, Frame, Image, Intrinsics, SnippetPoses
from slam.storage.cache import Answer, GetOrCompute, Given, without_cache


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

    def __init__(
        self, networks: Networks, intrinsics: Intrinsics, get_or_compute: GetOrCompute = without_cache
    ) -> None:
        """Ask networks about the frames of one sequence.

        Args:
            networks: whom to ask.
            intrinsics: of all images.
            recall: remembers what is measured of images and answers together.
        """
        self._networks = networks
        self._intrinsics = intrinsics
        self._get_or_compute = get_or_compute
        self._residual = PhotometricResidual(intrinsics.K, intrinsics.width, intrinsics.height)
        self._known: deque[tuple[int, NDArray[np.float32]]] = deque(maxlen=networks.sources + 1)
        self.sources = networks.sources

    def depth(self, frame: Frame) -> DepthMap:
        """Unscaled z-depth ``(H, W)`` at the image's size."""
        height, width = frame.image.shape[:2]
        return depth_at(self._disparity(frame), height, width)

    def snippet(self, frames: Sequence[Frame]) -> SnippetPoses:
        """Poses of the sources of a snippet; the target is the middle frame."""
        images = [frame.image for frame in frames]
        T_source_target = self._networks.poses(images)
        middle = self.sources // 2
        sources = tuple(f.index for k, f in enumerate(frames) if k != middle)
        disparity = self._disparity(frames[middle])
        given: list[Given] = [*images, disparity, T_source_target, repr(self._intrinsics)]

        def judge() -> Answer:
            return (self._residual.shares(images, disparity, T_source_target),)

        (residuals,) = self._get_or_compute("photometric residual", given, judge)
        return SnippetPoses(frames[middle].index, sources, T_source_target, residuals)

    def _disparity(self, frame: Frame) -> NDArray[np.float32]:
        for index, disparity in self._known:
            if index == frame.index:
                return disparity
        disparity = self._networks.disparity(frame.image)
        self._known.append((frame.index, disparity))
        return disparity
