"""Lengths by the road, with the camera's pitch against it by the path.

A car pitches on its springs, by which a length errs by 7 to 8 % a degree, and the images of the road tell its pitch
poorly. Single directions of motion tell it poorly too, for the camera also rises and falls. Over eight metres around a
frame the path is parallel to the road; where directions are noisy, it is so only on the average of many steps
(``docs/design/scale-and-lengths.md``).
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby

import numpy as np

from slam.frames import Ends
from slam.frontend.scale.road_homography import RoadStep
from slam.frontend.visual.motion import Steps, links, triangulated
from slam.geometry.robust import mad_sigma, running_median
from slam.geometry.se3 import FloatArray, chain, invert, path_distance

_REACH_HEIGHTS = 2.5  # of the path before and after a frame, in camera heights: 4 m of a car
_USUAL_STEPS = 101  # whose median direction is the usual one
_PITCH_SIGMA_DEG = 0.3  # of a car against its usual pitch, degrees
_OF_PATH = 0.5  # noise of the path's direction over that of a single step


def with_slope(road_steps: Mapping[Ends, RoadStep], steps: Steps) -> dict[Ends, RoadStep]:
    """The lengths of a drive by the road, with its normal by the path of all ``steps``, unscaled."""
    motions = {ends: motion for ends, motion in triangulated(steps).items() if ends in road_steps}
    if not motions:
        return dict(road_steps)
    ratios = [motion.length_unscaled / road_steps[ends].length_heights for ends, motion in motions.items()]
    by_path = _path_directions(steps, _REACH_HEIGHTS * float(np.median(ratios)))
    T_current_previous = invert(np.array([motion.relative_pose.T_from_to for motion in motions.values()]))
    own = -T_current_previous[:, :3, 3] / np.linalg.norm(T_current_previous[:, :3, 3], axis=1, keepdims=True)
    usual = np.column_stack([running_median(axis, _USUAL_STEPS) for axis in own.T])
    around = np.array([by_path.get(ends[1], often) for ends, often in zip(motions, usual, strict=True)])
    noise = _OF_PATH * mad_sigma((own - around)[:, 1])
    share = 1.0 / (1.0 + (noise / np.deg2rad(_PITCH_SIGMA_DEG)) ** 2)
    directions = zip(motions, usual + share * (around - usual), strict=True)
    return {**road_steps, **{ends: road_steps[ends].along(direction) for ends, direction in directions}}


def _path_directions(steps: Steps, reach: float) -> dict[int, FloatArray]:
    """The direction ``(3,)`` of the path within ``reach`` of a frame, in its camera, by the frame."""
    found: dict[int, FloatArray] = {}
    frames = 1 + max((last for _, last in steps), default=0)
    for is_measured, consecutive in groupby(links(steps, frames), steps.__contains__):
        if not is_measured:
            continue
        run = list(consecutive)
        T = chain(np.array([steps[ends].relative_pose.T_from_to for ends in run]))
        places = path_distance(T)
        behind, ahead = (
            np.column_stack([np.interp(places + sign * reach, places, T[:, axis, 3]) for axis in range(3)])
            for sign in (-1, 1)
        )
        chords = np.einsum("nba,nb->na", T[:, :3, :3], ahead - behind)
        seen_from = [run[0][0], *(last for _, last in run)]
        known = zip(seen_from, chords, np.linalg.norm(chords, axis=1), strict=True)
        found |= {frame: chord / length for frame, chord, length in known if length > reach}
    return found
