"""Which views of a drive measure the depth of one of them: about as far away as gives parallax, and turned little."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

BASELINES = (0.07, 0.2)  # wanted distances over the median depth
_RANGE = 2.5  # accepted factor on these
_LARGEST_TURN_DEG = 20.0
_MOST_NEIGHBOURS = 3
_MAX_FRAMES_APART = 40


def neighbours(T_world_camera: NDArray[np.float64], target: int, wanted: Iterable[float]) -> list[int]:
    """The best view of each wanted distance, each once, in the order of these; none where no view is usable.

    Args:
        T_world_camera: poses ``(N, 4, 4)`` in time order.
        target: row of the view to measure.
        wanted: distances in the unit of the poses; a negative one is of a view before the target.
    """
    T_target_other = np.linalg.inv(T_world_camera[target]) @ T_world_camera
    distance = np.linalg.norm(T_target_other[:, :3, 3], axis=1)
    cosine = (np.trace(T_target_other[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    usable = np.arccos(np.clip(cosine, -1, 1)) < np.deg2rad(_LARGEST_TURN_DEG)
    after = np.arange(len(distance)) > target
    usable[target] = False
    chosen: list[int] = []
    for length in wanted:
        off = np.abs(np.log(np.maximum(distance, 1e-9) / abs(length)))
        possible = usable & (after == (length > 0)) & (off < np.log(_RANGE))
        if possible.any():
            chosen.append(int(np.where(possible, off, np.inf).argmin()))
            usable[chosen[-1]] = False
    return chosen


def neighbours_around(
    T_world_camera: NDArray[np.float64], target: int, median_depth: float, frames: Sequence[int] | NDArray[np.int64]
) -> list[int]:
    """The views that refine the depth of one, in time order: the best at each distance of ``BASELINES``, three at most.

    Those after come first, for they are nearer to what is ahead.

    Args:
        T_world_camera: poses ``(N, 4, 4)`` in time order.
        target: row of the view.
        median_depth: of it, in the unit of the poses.
        frames: number of each view's frame ``(N,)``, ascending: those too far away in time are left out.
    """
    near = np.flatnonzero(np.abs(np.asarray(frames) - frames[target]) <= _MAX_FRAMES_APART)
    wanted = [sign * baseline * median_depth for sign in (1, -1) for baseline in BASELINES]
    chosen = neighbours(T_world_camera[near], target - int(near[0]), wanted)
    return sorted(int(near[row]) for row in chosen[:_MOST_NEIGHBOURS])
