"""Double walls where two passes overlap, before and after loops were closed."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from slam.evaluation.double_walls import double_wall_share
from slam.formats.trajectory import Trajectory
from slam.geometry.se3 import apply, invert
from slam.loops.closure import LoopClosures
from slam.mapping.map import TsdfMap
from slam.results.summary import null

AT_LOOPS = "double_wall_share_at_loops"


def double_walls_at_loops(
    tsdf_map: TsdfMap, loops: LoopClosures, before: Trajectory, after: Trajectory
) -> dict[str, Any]:
    """Of the two submaps that most loops join, the share of double walls by two trajectories; a reason without any.

    Each submap is moved rigidly, with the frame in its middle.

    Args:
        tsdf_map: whose finished submaps are on disk.
        loops: those that were accepted join submaps.
        before: the trajectory without loops.
        after: the trajectory that the map was fused at.
    """
    ends = [{number for number in map(tsdf_map.submap_of, loop.ends) if number is not None} for loop in loops.accepted]
    joined = Counter(tuple(sorted(numbers)) for numbers in ends if len(numbers) == 2)
    if not joined:
        return null(AT_LOOPS, "no loop joins two submaps")
    ((numbers, _),) = joined.most_common(1)
    anchors = [tsdf_map.submap_anchor(number) for number in numbers]
    (one, one_triangles), (other, other_triangles) = map(tsdf_map.submap_mesh, numbers)
    triangles = np.concatenate([one_triangles, other_triangles + len(one)])
    if not len(triangles):
        return null(AT_LOOPS, "the submaps that loops join have no surface")
    shares = {}
    for name, trajectory in (("before", before), ("after", after)):
        moves = (trajectory.T_world_camera[k] @ invert(after.T_world_camera[k]) for k in anchors)
        vertices = np.concatenate([apply(T, mesh) for T, mesh in zip(moves, (one, other))])
        shares[name] = double_wall_share([(vertices, triangles)])
    return {AT_LOOPS: shares}
