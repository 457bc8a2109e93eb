"""The map of a finished estimate: learned depth of its keyframes, refined and fused."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing

from erfsfm.common.progress import Progress
from erfsfm.mvs.refine import Decide
from slam.config.sections import SlamConfig
from slam.frames import Intrinsics
from slam.frontend.visual.depth_error import DepthError
from slam.mapping.filters import KeyframeDepth
from slam.mapping.map import TsdfMap
from slam.pipeline.estimate import Estimate
from slam.pipeline.keyframe_depth import ROOM_SIGMA, KeyframeDepths
from slam.runtime.threads import CORES, read_ahead


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
    guess_sigma = ROOM_SIGMA if is_carried and config.depth.is_learned else None
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
