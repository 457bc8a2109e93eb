from __future__ import annotations

import numpy as np
import pytest

from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.frontend.keyframes.units import units_by_floor
from slam.geometry.se3 import from_rotation_vector, invert

HEIGHT_M = 1.5


def a_map(unit_m: float, pitch_deg: float, seed: int, see_floor: bool = True) -> LocalMap:
    """Walls and a table, and the floor, seen by cameras that are held somewhat downwards; lengths over the unit."""
    rng = np.random.default_rng(seed)
    walls = np.column_stack(
        [rng.uniform(-3, 3, 300), rng.uniform(-1, 1, 300), rng.uniform(4, 4.1, 300)]
    )
    table = np.column_stack(
        [rng.uniform(-1, 0, 60), rng.uniform(0.7, 0.71, 60), rng.uniform(2, 3, 60)]
    )
    floor = np.column_stack([rng.uniform(-3, 3, 80), np.full(80, HEIGHT_M), rng.uniform(2, 4, 80)])
    points = np.concatenate([walls, table, floor] if see_floor else [walls, table])
    points += rng.normal(0.0, 0.01, points.shape)
    T_room_map = from_rotation_vector(np.deg2rad([-pitch_deg, 0.0, 0.0]), np.zeros(3))
    keyframes = []
    for k in range(5):
        T = T_room_map.copy()
        T[:3, 3] = [0.2 * k, rng.normal(0.0, 0.03), 0.0]
        T_map_camera = invert(T_room_map) @ T
        T_map_camera[:3, 3] /= unit_m
        nothing, tracks = np.zeros((len(points), 2)), np.arange(len(points))
        unknown, bits = np.full(len(points), np.nan), np.zeros((len(points), 32), np.uint8)
        keyframes.append(
            TrackedKeyframe(k, invert(T_map_camera), tracks, nothing, nothing, unknown, bits, None)
        )
    return LocalMap(keyframes, points @ T_room_map[:3, :3] / unit_m)


def test_maps_of_one_floor_have_one_unit():
    """Learned depth says 1.2 and 0.9 times the true units; one map sees no floor, one is far from it."""
    true = [0.5, 2.0, 1.0, 1.0]
    maps = [
        a_map(0.5, 15.0, 0),
        a_map(2.0, 5.0, 1),
        a_map(1.0, 10.0, 2, see_floor=False),
        a_map(1.0, 10.0, 3),
    ]
    learned = [0.6, 1.8, 1.3, 5.0]
    found = units_by_floor(maps, learned)
    assert found[2:] == learned[2:]
    assert found[0] / found[1] == pytest.approx(true[0] / true[1], rel=0.06)
    assert units_by_floor(maps[:1], learned[:1]) == learned[:1]
