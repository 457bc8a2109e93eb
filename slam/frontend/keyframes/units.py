"""The units of maps of keyframes: by learned depth, with its drift along a map, and by the floor.

The height of a carried camera above the floor is what all maps of a drive have in common.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solveh_banded

from slam.frontend.keyframes.local_map import LocalMap
from slam.geometry.robust import difference_equations, mad_sigma, median
from slam.geometry.se3 import FloatArray

_LEAST_DEPTHS = 20
_SHARED = 10  # keyframes that share an error of learned depth
# of the logarithm of the unit of an image's learned depth, where it is not measured
_SIGMA = 0.3
_LEAST_SIGMA = 0.05
# of planes that are drawn for the floor
_SAMPLES = 1000
_ROUNDS = 3
_MOST_POINTS = 2000  # by which planes are compared
_LEAST_COSINE = 0.8  # between the plane's normal and down by the cameras, which are held upright
_THICKNESS = 0.04  # of the floor, over the camera's height
# points on the floor, over all, and in number
_LEAST_RATIO = 0.04
_LEAST_POINTS = 25
_MOST_BELOW = 0.5  # points below the floor over those on it: a table has the floor below it
_MOST_SPREAD = 0.15  # of the camera's height
_MOST_CONTRADICTION = np.log(1.4)  # between two units of a map: a table is half as high


def learned_unit(local: LocalMap) -> float:
    """Learned depth over depth in the map, the median over all sightings by keyframes; 1 where there are few."""
    joined = np.concatenate([local.ratios(keyframe) for keyframe in local.keyframes])
    known = joined[joined > 0.0]
    return median(1.0 / known) if len(known) >= _LEAST_DEPTHS else 1.0


def learned_units(local: LocalMap, carried: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Learned depth over depth in the map along it ``(K,)``, and over what each keyframe says of it ``(K,)``.

    The logarithm of the unit is a random walk with sigmas ``carried`` ``(K - 1,)`` from each
    keyframe to the next.
    """
    own = np.full(len(local.keyframes), np.nan)
    for row, keyframe in enumerate(local.keyframes):
        ratios = local.ratios(keyframe)
        known = ratios[ratios > 0.0]
        if len(known) >= _LEAST_DEPTHS:
            own[row] = -median(np.log(known))
    if not np.isfinite(own).any():
        return np.ones(len(own)), np.ones(len(own))
    # the scatter of the units of learned depth about that of the map, by keyframes that share no
    # error
    apart = own[_SHARED:] - own[:-_SHARED]
    apart = apart[np.isfinite(apart)]
    usual = _SIGMA
    if len(apart) >= _SHARED:
        usual = float(np.clip(mad_sigma(apart) / np.sqrt(2.0), _LEAST_SIGMA, _SIGMA))
    weight = np.where(np.isfinite(own), 0.5 / _SHARED / usual**2, 0.0)
    own = np.nan_to_num(own)
    units = np.arange(len(own))
    zero = np.full(len(own), len(own))  # behind the last unit
    information, right = difference_equations(
        np.concatenate([units[1:], units]),
        np.concatenate([units[:-1], zero]),
        np.concatenate([0.0 * carried, own]),
        np.concatenate([carried**-2.0, weight]),
        0.0 * own,
    )
    walk = np.asarray(solveh_banded(information[-len(own) :], right))
    return np.exp(walk), np.exp(np.where(weight > 0.0, walk - own, 0.0))


def units_by_floor(
    maps: Sequence[LocalMap], learned_units: Sequence[float], seed: int = 0
) -> list[float]:
    """The units of maps, so that the camera has one height in all that see a floor.

    They are the learned ones where the floor contradicts these.

    Args:
        maps: all of one drive.
        learned_units: of learned depth per unit of each map.
        seed: of the planes that are drawn.
    """
    units = list(learned_units)
    floors: dict[int, float] = {}
    for row, local in enumerate(maps if len(maps) > 1 else ()):
        height = height_above_floor(local, seed)
        if height is not None:
            floors[row] = height
    if floors:
        logarithms = [np.log(height * units[row]) for row, height in floors.items()]
        common = float(np.exp(np.median(logarithms)))
        for row, height in floors.items():
            if abs(np.log(common / height / units[row])) < _MOST_CONTRADICTION:
                units[row] = common / height
    return units


def height_above_floor(local: LocalMap, seed: int = 0) -> float | None:
    """The median height of the keyframes above the plane below which nothing is; None where no such plane is seen."""
    T_map_camera = local.T_world_camera
    centres = T_map_camera[:, :3, 3]
    down = T_map_camera[:, :3, 1].mean(axis=0)
    seen = np.unique(np.concatenate([keyframe.track_ids for keyframe in local.keyframes]))
    points = local.points[seen[local.parallax(local.keyframes).settled[seen]]]
    if len(points) < _LEAST_POINTS:
        return None
    origin = np.median(centres, axis=0)
    points, centres = points - origin, centres - origin
    rng = np.random.default_rng(seed)
    points = rng.permutation(points)[:_MOST_POINTS]
    depth = points @ down
    low = points[depth >= np.median(depth[depth > 0])] if (depth > 0).any() else points
    corners = low[rng.integers(len(low), size=(_SAMPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals, first = normals[length > 0] / length[length > 0, None], corners[length > 0, 0]
    normals *= np.sign(normals @ down)[:, None]
    heights = np.sum(normals * first, axis=1)
    possible = (normals @ down > _LEAST_COSINE * np.linalg.norm(down)) & (heights > 0)
    if not possible.any():
        return None
    normals, heights = normals[possible], heights[possible]
    over = points @ normals.T / heights - 1.0
    on, below = (np.abs(over) < _THICKNESS).sum(axis=0), (over > _THICKNESS).sum(axis=0)
    best = int(np.argmax(on - below / _MOST_BELOW))
    normal, height = normals[best], float(heights[best])
    for _ in range(_ROUNDS):
        floor = points[np.abs(points @ normal / height - 1.0) < _THICKNESS]
        if len(floor) < max(_LEAST_POINTS, _LEAST_RATIO * len(points)):
            return None
        middle = floor.mean(axis=0)
        normal = np.linalg.svd(floor - middle, full_matrices=False)[2][2]
        normal *= np.sign(normal @ down)
        height = float(normal @ middle)
    below = (points @ normal > (1.0 + _THICKNESS) * height).sum()
    heights_above = height - centres @ normal
    usual = median(heights_above)
    is_level = (
        normal @ down > _LEAST_COSINE * np.linalg.norm(down)
        and np.std(heights_above) < _MOST_SPREAD * usual
    )
    return usual if is_level and below < _MOST_BELOW * len(floor) else None
