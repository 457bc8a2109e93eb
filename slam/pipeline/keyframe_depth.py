"""Metric depth of the keyframes of a finished estimate, refined where the configuration says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from erfsfm.mvs.refine import RefinedDepth, Road
from slam.config.sections import DepthConfig, MappingConfig
from slam.frames import DepthMap, Image, Intrinsics
from slam.frontend.drive import Drive, Keyframe
from slam.frontend.scale.road_plane import GroundPlane
from slam.geometry.se3 import FloatArray
from slam.mapping.depth_refinement import DepthRefiner

_SOME = 20
_STREET_DEPTH_M = 15.0  # median depth of a street


@dataclass(frozen=True)
class KeyframeDepth:
    """A keyframe's image ``(H, W, 3)``, the network's depth ``(H, W)`` in the unit of the trajectory, and that refined.

    ``refined`` is None where refinement is switched off or no neighbour is at a useful distance.
    """

    index: int
    image: Image
    depth: DepthMap
    refined: RefinedDepth | None

    @property
    def best(self) -> DepthMap:
        """The depth to fuse: refined where it was."""
        return self.depth if self.refined is None else self.refined.depth

    @property
    def relative_sigma(self) -> DepthMap | None:
        """Sigma of the depth to fuse, relative to it; None where it is the network's, which states none."""
        return None if self.refined is None else self.refined.relative_sigma


class KeyframeDepths:
    """Depth of each keyframe of a drive, at the optimised poses."""

    def __init__(
        self,
        drive: Drive,
        scale_per_frame: FloatArray,
        T_world_camera: FloatArray,
        intrinsics: Intrinsics,
        config: DepthConfig,
    ) -> None:
        """Prepare.

        Args:
            drive: with at least one keyframe.
            scale_per_frame: factor ``(N,)`` on unscaled depth.
            T_world_camera: poses of all frames ``(N, 4, 4)``.
            intrinsics: of the keyframes.
            config: whether to refine.
        """
        self._keyframes: Sequence[Keyframe] = drive.keyframes
        self._roads = drive.roads
        self._scale = scale_per_frame
        self._refiner: DepthRefiner | None = None
        if config.refine == "multiview":
            indices = [keyframe.index for keyframe in self._keyframes]
            self._refiner = DepthRefiner(
                intrinsics, indices, T_world_camera[indices], lambda n: self._keyframes[n].image
            )

    def fitted(self, mapping: MappingConfig) -> MappingConfig:
        """The settings with their lengths scaled from a street to this scene, by the median of known depth.

        Where no depth is known they stay as they are.
        """
        some = np.linspace(0, len(self._keyframes) - 1, _SOME).round().astype(int)
        depths = (self._of_network(self._keyframes[n]) for n in np.unique(some))
        medians = [np.median(known) for depth in depths if (known := depth[np.isfinite(depth)]).size]
        return mapping.in_unit(float(np.median(medians)) / _STREET_DEPTH_M) if medians else mapping

    def at(self, n: int) -> KeyframeDepth:
        """The n-th keyframe."""
        keyframe = self._keyframes[n]
        scale, depth = float(self._scale[keyframe.index]), self._of_network(keyframe)
        refined = None
        if self._refiner is not None:
            plane = self._roads[keyframe.index]
            road = Road(plane.normal, plane.height_unscaled * scale) if isinstance(plane, GroundPlane) else None
            refined = self._refiner.refine(n, depth, road)
        return KeyframeDepth(keyframe.index, keyframe.image, depth, refined)

    def _of_network(self, keyframe: Keyframe) -> DepthMap:
        return keyframe.depth_unscaled * np.float32(self._scale[keyframe.index])
