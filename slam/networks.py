"""The trained networks behind the ``Predictor`` protocol: frames in, snippet poses and depth out."""

from __future__ import annotations

from collections.abc import Sequence

from erfsfm.inference import DepthPosePredictor
from slam.frames import DepthMap, Frame, SnippetPoses


class NetworkPredictor:
    """Answers by frame what ``DepthPosePredictor`` answers by image."""

    def __init__(self, predictor: DepthPosePredictor) -> None:
        self._predictor = predictor
        self.sources = predictor.sources

    def depth(self, frame: Frame) -> DepthMap:
        """Unscaled z-depth ``(H, W)`` at the image's size."""
        return self._predictor.depth(frame.image)

    def snippet(self, frames: Sequence[Frame]) -> SnippetPoses:
        """Poses of the sources of a snippet; the target is the middle frame."""
        T_source_target = self._predictor.poses([frame.image for frame in frames])
        middle = self.sources // 2
        sources = tuple(f.index for k, f in enumerate(frames) if k != middle)
        return SnippetPoses(frames[middle].index, sources, T_source_target)
