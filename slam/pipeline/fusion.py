"""The map of a finished estimate: learned depth of its keyframes, refined if so configured, and fused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing

import numpy as np

from erfsfm.common.progress import Progress
from erfsfm.mvs.refine import Decide
from slam.config.sections import MappingConfig, SlamConfig
from slam.frames import Intrinsics
from slam.frontend.drive import Drive, Keyframe
from slam.frontend.visual.depth_error import DepthError
from slam.geometry.se3 import FloatArray
from slam.mapping.depth_refinement import DepthRefiner
from slam.mapping.filters import KeyframeDepth
from slam.mapping.map import TsdfMap
from slam.pipeline.estimate import Estimate
from slam.runtime.threads import CORES, read_ahead

# relative sigma of learned depth in rooms, in the unit of the drive: 90 % of the errors are within 1.645 sigmas
_ROOM_SIGMA = 0.32
_SOME = 20
_STREET_DEPTH_M = 15.0  # median depth of a street


def fuse(
    estimate: Estimate,
    intrinsics: Intrinsics,
    config: SlamConfig,
    decide: Decide | None,
    compare: Callable[[KeyframeDepth], None] | None,
    progress: Progress,
) -> TsdfMap:
    """Learned depth at the optimised poses, refined and fused into one surface.

    A camera that is carried turns on the spot, where nothing measures learned depth. The error of that over
    distance is known by steps, which measure only the first frames there, and is not taken out.

    Args:
        estimate: with keyframes.
        intrinsics: of the sequence's images.
        config: of all parts.
        decide: between learned and measured depth; None where it is not refined.
        compare: called with the depth of each keyframe that is far enough from the one before.
        progress: called with the stage, done and total.
    """
    keyframes, T_world_camera = estimate.drive.keyframes, estimate.optimised.T_world_camera
    height, width = keyframes[0].depth_unscaled.shape
    intrinsics = intrinsics.resized(width, height)
    scales, is_carried = estimate.scale.per_frame, bool(estimate.drive.maps)
    error = DepthError() if is_carried else estimate.depth_error
    guess_sigma = _ROOM_SIGMA if is_carried and config.depth.is_learned else None
    depths = KeyframeDepths(estimate.drive, scales, T_world_camera, error, intrinsics, decide, guess_sigma)
    mapping = config.mapping if estimate.scale.is_metric else depths.fitted(config.mapping)
    tsdf_map = TsdfMap(mapping, intrinsics)
    selected = tsdf_map.select([keyframe.index for keyframe in keyframes], T_world_camera)
    with closing(read_ahead(depths.at, selected, CORES)) as ahead:
        for done, keyframe in enumerate(estimate.stopwatch.each("depth refinement", ahead), 1):
            if compare is not None:
                compare(keyframe)
            with estimate.stopwatch.stage("map"):
                tsdf_map.integrate(keyframe)
            progress("map", done, len(selected))
    return tsdf_map


class KeyframeDepths:
    """Depth of each keyframe of a drive, at the optimised poses."""

    def __init__(
        self,
        drive: Drive,
        scale_per_frame: FloatArray,
        T_world_camera: FloatArray,
        error: DepthError,
        intrinsics: Intrinsics,
        decide: Decide | None,
        guess_sigma: float | None = None,
    ) -> None:
        """Prepare.

        Args:
            drive: with at least one keyframe.
            scale_per_frame: factor ``(N,)`` on unscaled depth.
            T_world_camera: poses of all frames ``(N, 4, 4)``.
            error: of learned depth on this drive, taken out before depth is refined or fused.
            intrinsics: of the keyframes.
            decide: between learned and measured depth; None where it is not refined.
            guess_sigma: relative sigma of depth that was to be refined and has no neighbours; None where unknown.
        """
        self._keyframes: Sequence[Keyframe] = drive.keyframes
        self._scale, self._T_world_camera, self._error = scale_per_frame, T_world_camera, error
        self._guess_sigma = None if decide is None else guess_sigma
        self._refiner: DepthRefiner | None = None
        if decide is not None:
            indices = [keyframe.index for keyframe in self._keyframes]
            self._refiner = DepthRefiner(
                intrinsics, indices, T_world_camera[indices], lambda n: self._keyframes[n].image, decide
            )

    def fitted(self, mapping: MappingConfig) -> MappingConfig:
        """The settings with their lengths scaled from a street to this scene, by the median of known depth.

        Where no depth is known they stay as they are.
        """
        some = np.linspace(0, len(self._keyframes) - 1, _SOME).round().astype(int)
        chosen = (self._keyframes[n] for n in np.unique(some))
        depths = (each.depth_unscaled * np.float32(self._scale[each.index]) for each in chosen)
        medians = [np.median(known) for depth in depths if (known := depth[np.isfinite(depth)]).size]
        return mapping.in_unit(float(np.median(medians)) / _STREET_DEPTH_M) if medians else mapping

    def at(self, n: int) -> KeyframeDepth:
        """The n-th keyframe in the unit of the trajectory; without a sigma where nothing is known of its error."""
        keyframe = self._keyframes[n]
        scale, learned = float(self._scale[keyframe.index]), keyframe.depth_unscaled
        depth, unbiased = learned * np.float32(scale), (self._error.corrected(learned) * scale).astype(np.float32)
        refined = None
        if self._refiner is not None:
            refined = self._refiner.refine(n, unbiased)
        image, pose = keyframe.image, self._T_world_camera[keyframe.index]
        if refined is None:
            sigma = None if self._guess_sigma is None else np.full_like(unbiased, self._guess_sigma)
            return KeyframeDepth(keyframe.index, unbiased, sigma, image, pose, depth)
        return KeyframeDepth(keyframe.index, refined.depth, refined.relative_sigma, image, pose, depth)
