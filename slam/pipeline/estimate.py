"""The estimate that fits the measurements of a drive, and the depth of its keyframes as the map takes it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from erfsfm.mvs.refine import Decide
from slam.config.sections import MappingConfig
from slam.formats.trajectory import Trajectory
from slam.frames import Intrinsics, RelativePose, View
from slam.frontend.agreement import Agreement
from slam.frontend.drive import Drive
from slam.frontend.gps import Location
from slam.frontend.lidar_odometry import LidarPath
from slam.frontend.scale import Scale
from slam.frontend.visual.depth_error import DepthError
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray
from slam.graph.pose_graph import PoseGraph
from slam.loops.closure import LoopClosures
from slam.loops.places import Places
from slam.mapping.depth import DepthRefiner, KeyframeDepth
from slam.mapping.map import TsdfMap
from slam.runtime.errors import Failed
from slam.runtime.stopwatch import Stopwatch

_SOME = 20
_STREET_DEPTH_M = 15.0  # median depth of a street


@dataclass(frozen=True)
class Estimate:
    """Trajectories with one row a frame, the factors and loops they fit, the graph, and the map once it is fused.

    ``drive`` is completed, its rotations smoothed; the points of ``views`` are in the unit of the trajectories.
    ``graph`` is the reason where it has no solution: the optimised trajectory then is the odometry.
    ``location`` is None without a GPS track, and the reason where the track cannot be used. ``agreements`` say how far
    each optional source contradicts the images, ``confidence`` what follows from all of them, or why nothing does,
    and ``shape`` what follows for the trajectory after one fitted scale.
    """

    network: Trajectory
    odometry: Trajectory
    optimised: Trajectory
    lidar: LidarPath | Failed | None
    reference: Trajectory | None
    drive: Drive
    scale: Scale
    factors: list[RelativePose]
    views: list[View]
    loops: LoopClosures
    graph: PoseGraph | Failed
    location: Location | Failed | None
    stopwatch: Stopwatch
    confidence: float | Failed
    shape: float | Failed
    agreements: Sequence[Agreement] = ()
    map: TsdfMap | None = None

    def places(self, intrinsics: Intrinsics) -> Places:
        """Every view with its points at the poses of the optimised trajectory, and the camera."""
        frames = np.array([view.index for view in self.views], dtype=np.intp)
        return Places(intrinsics, tuple(self.views), self.optimised.T_world_camera[frames])


def fitted(mapping: MappingConfig, drive: Drive, scale_per_frame: FloatArray) -> MappingConfig:
    """The settings with their lengths scaled from a street to this scene, by the median of known depth.

    Where no depth is known they stay as they are.
    """
    some = np.linspace(0, len(drive.keyframes) - 1, _SOME).round().astype(int)
    medians = []
    for number in np.unique(some):
        keyframe = drive.keyframes[number]
        depth = keyframe.depth_unscaled * np.float32(scale_per_frame[keyframe.index])
        known = depth[np.isfinite(depth)]
        if known.size:
            medians.append(np.median(known))
    return mapping.in_unit(median(medians) / _STREET_DEPTH_M) if medians else mapping


def keyframe_depths(
    drive: Drive,
    scale_per_frame: FloatArray,
    T_world_camera: FloatArray,
    intrinsics: Intrinsics,
    decide: Decide | None,
    guess_sigma: float | None,
) -> Callable[[int], KeyframeDepth]:
    """The depth of the n-th keyframe of a drive in the unit of the trajectory, as a function of n.

    The error of learned depth is taken out first; where it is too near half of that, for what moves along with the
    camera only seems to be far. A camera that is carried turns on the spot, where nothing measures learned depth: its
    error over distance is known by steps, which measure only the first frames there, and stays.
    ``scale_per_frame`` ``(N,)`` and ``T_world_camera`` ``(N, 4, 4)`` are of all frames. ``guess_sigma`` is that of
    depth that was to be refined and has no neighbours, None for none.
    """
    keyframes, refiner = drive.keyframes, None
    error = DepthError() if drive.by_keyframes else drive.measured.depth_error
    if decide is not None:
        indices = [keyframe.index for keyframe in keyframes]
        refiner = DepthRefiner(
            intrinsics, indices, T_world_camera[indices], lambda n: keyframes[n].image, decide
        )

    def depth_at(n: int) -> KeyframeDepth:
        keyframe = keyframes[n]
        scale, learned = float(scale_per_frame[keyframe.index]), keyframe.depth_unscaled
        unbiased, sigma = error.corrected(learned), None
        guess = np.minimum(unbiased, np.sqrt(unbiased * learned))
        depth = (guess * scale).astype(np.float32)
        if refiner is not None and (refined := refiner.refine(n, depth)) is not None:
            depth, sigma = refined.depth, refined.relative_sigma
            # what is fixed to the camera, as its neighbours show it, too
            sigma[learned == 0] = np.inf
        elif refiner is not None and guess_sigma is not None:
            sigma = np.full_like(depth, guess_sigma)
        pose, of_network = T_world_camera[keyframe.index], learned * np.float32(scale)
        return KeyframeDepth(keyframe.index, depth, sigma, keyframe.image, pose, of_network)

    return depth_at
