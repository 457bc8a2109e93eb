"""Interpolated steps of a gap whose two sides lie in one map: they lead from the one to the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from itertools import pairwise

import numpy as np

from slam.frames import RelativePose, runs
from slam.frontend.gap_interpolation import equal_step
from slam.frontend.keyframes.relative_poses import chained
from slam.geometry.se3 import invert


def join_gap_ends(
    interpolated: Sequence[RelativePose],
    measured: Sequence[RelativePose],
    by_map: Sequence[RelativePose],
    maps: Mapping[int, int],
) -> list[RelativePose]:
    """The interpolated steps. Equal steps across a gap replace the steps in the gap if one map has both sides.

    Constant velocity is a poor guess over a long gap, and many such steps would outvote the one pose by the map.

    Args:
        interpolated: steps without a measurement, in one unit with all others.
        measured: steps between other frames.
        by_map: relative poses within maps.
        maps: the map of each frame that has a pose in one.
    """
    T_map_camera = chained(by_map)
    loose = {pose.from_index: pose for pose in interpolated}
    T_step = {pose.from_index: pose.T_from_to for pose in measured if pose.to_index == pose.from_index + 1}
    T_step |= {first: pose.T_from_to for first, pose in loose.items()}
    for first, last in pairwise(sorted(maps)):
        steps = range(first, last)
        if maps[first] != maps[last] or loose.keys().isdisjoint(steps) or not T_step.keys() >= set(steps):
            continue
        begin, end = max(runs(loose.keys() & set(steps)), key=lambda run: run[1] - run[0])
        T_first_begin = reduce(np.matmul, (T_step[k] for k in range(first, begin)), np.eye(4))
        T_end_last = reduce(np.matmul, (T_step[k] for k in range(end + 1, last)), np.eye(4))
        T_first_last = invert(T_map_camera[first]) @ T_map_camera[last]
        T = equal_step(invert(T_first_begin) @ T_first_last @ invert(T_end_last), end + 1 - begin)
        length = float(np.linalg.norm(T[:3, 3]))
        for k in range(begin, end + 1):
            sigmas = np.maximum(loose[k].sigmas, [0.0, 0.0, 0.0, length, length, length])
            loose[k] = replace(loose[k], T_from_to=T, sigmas=sigmas)
    return list(loose.values())
