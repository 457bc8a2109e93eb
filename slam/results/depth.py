"""Errors of a run's depth maps where the true depth is known: ``depth`` of ``metrics.json``."""

from __future__ import annotations

import logging

import numpy as np

from slam.evaluation.depth import DepthErrors
from slam.frames import DepthMap, Intrinsics, Sequence
from slam.geometry.se3 import FloatArray, apply
from slam.mapping.filters import KeyframeDepth
from slam.results.map_error import NEAREST_M, HasTrueDepth
from slam.results.metrics import DepthOfKeyframes
from slam.runtime.errors import Failed, SlamError

logger = logging.getLogger(__name__)

_EVERY_RENDERED = 5  # rendering a keyframe's true depth takes as long as refining it


class DepthQuality:
    """Collects the errors of keyframes while the map is fused."""

    def __init__(self, sequence: Sequence, is_metric: bool) -> None:
        """``is_metric`` tells whether the run's depth is in metres."""
        self._sequence, self._is_metric = sequence, is_metric
        self._network, self._refined = DepthErrors(), DepthErrors()
        self._keyframes = 0
        self._unreadable: list[str] = []

    def add(self, keyframe: KeyframeDepth) -> None:
        """Compare a keyframe with the truth, where it is known and can be read."""
        self._keyframes += 1
        if not self._is_metric:
            return
        try:
            truth = true_depth(self._sequence, keyframe.frame, self._keyframes)
        except SlamError as error:
            self._unreadable.append(str(error))
            return
        if truth is None:
            return
        self._network.add(keyframe.depth if keyframe.network_depth is None else keyframe.network_depth, truth)
        if keyframe.relative_sigma is not None:
            self._refined.add(keyframe.depth, truth, keyframe.relative_sigma)

    def metrics(self, is_refined: bool) -> DepthOfKeyframes:
        """The errors, each missing with a reason where it cannot be computed; warns of unread maps."""
        network, refined = self._network.metrics(), self._refined.metrics()
        unreadable = f"the true depth of {len(self._unreadable)} keyframes cannot be read"
        if self._unreadable:
            logger.warning("%s, first %s: they are not compared", unreadable, self._unreadable[0])
        missing = "the sequence has no true depth (simulated, depth_2 or LiDAR)"
        if self._unreadable:
            missing = unreadable
        if self._keyframes == 0:
            missing = "there are no keyframes (mapping.enabled)"
        elif not self._is_metric:
            missing = "depth is not in metres (see scale)"
        elsewhere = "no keyframe has a neighbour at a useful distance" if is_refined else "depth.refine is none"
        why_not_refined = missing if network is None else elsewhere
        return DepthOfKeyframes.of(network=network or Failed(missing), refined=refined or Failed(why_not_refined))


def true_depth(sequence: Sequence, index: int, count: int = 1) -> DepthMap | None:
    """The true z-depth ``(H, W)`` of a frame, 0 where unknown; None without any.

    Of a simulated street only every fifth ``count`` is rendered.

    Raises:
        SlamError: a depth map or a scan cannot be read.
    """
    if getattr(sequence, "street", None) is not None and count % _EVERY_RENDERED != 1:
        return None
    if isinstance(sequence, HasTrueDepth) and index in sequence.true_depth_frames():
        return np.asarray(sequence.true_depth(index), np.float32)
    if sequence.T_camera_lidar is None or not sequence.has_scan(index):
        return None
    return projected(sequence.scan(index), sequence.T_camera_lidar, sequence.intrinsics)


def projected(points_lidar: FloatArray, T_camera_lidar: FloatArray, intrinsics: Intrinsics) -> DepthMap:
    """z-depth ``(H, W)`` of LiDAR points ``(P, 3)`` in the image, the nearest at each pixel, 0 where there is none."""
    points = apply(T_camera_lidar, np.asarray(points_lidar, np.float64))
    points = points[points[:, 2] > NEAREST_M]
    u, v = np.rint(intrinsics.project(points)).astype(int).T
    inside = (u >= 0) & (u < intrinsics.width) & (v >= 0) & (v < intrinsics.height)
    depth = np.full((intrinsics.height, intrinsics.width), np.inf, np.float32)
    np.minimum.at(depth, (v[inside], u[inside]), points[inside, 2].astype(np.float32))
    return np.where(np.isfinite(depth), depth, np.float32(0))
