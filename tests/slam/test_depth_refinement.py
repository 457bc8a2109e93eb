from __future__ import annotations

import numpy as np
import pytest

from slam.depth_refinement import DepthRefiner
from slam.frames import Intrinsics

CAMERA = Intrinsics(64, 32, 50.0, 50.0, 31.5, 15.5)
DEPTH = np.full((32, 64), 10.0, np.float32)


def refiner(distances: np.ndarray, read: list[int]) -> DepthRefiner:
    T_world_camera = np.tile(np.eye(4), (len(distances), 1, 1))
    T_world_camera[:, 2, 3] = distances
    rng = np.random.default_rng(0)

    def image(n: int) -> np.ndarray:
        read.append(n)
        return rng.integers(0, 255, (32, 64, 3), dtype=np.uint8)

    return DepthRefiner(CAMERA, range(len(distances)), T_world_camera, image)


@pytest.mark.parametrize(("step_m", "expected"), [(1.0, {8, 9, 10, 11, 12}), (0.1, {10, 3, 17, 30, -10})])
def test_neighbours_are_chosen_by_their_distance(step_m: float, expected: set[int]) -> None:
    read: list[int] = []
    offset = 20 if step_m < 1 else 0
    n = 10 + offset
    assert refiner(np.arange(80) * step_m, read).refine(n, DEPTH, None) is not None
    assert {k - offset for k in read} == expected


def test_a_standing_camera_has_no_neighbours() -> None:
    assert refiner(np.zeros(20), []).refine(10, DEPTH, None) is None


def test_depth_with_holes_is_left_alone() -> None:
    holes = DEPTH.copy()
    holes[3, 4] = 0
    assert refiner(np.arange(20.0), []).refine(10, holes, None) is None
