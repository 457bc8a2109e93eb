from __future__ import annotations

import numpy as np
import pytest

from erfsfm.mvs.fusion import DepthFusion
from slam.config.sections import MappingConfig
from slam.frames import Intrinsics
from slam.mapping.depth import DepthFilters, DepthRefiner, KeyframeDepth

CAMERA = Intrinsics(64, 32, 50.0, 50.0, 31.5, 15.5)
DEPTH = np.full((32, 64), 10.0, np.float32)


def refiner(distances: np.ndarray, read: list[int]) -> DepthRefiner:
    T_world_camera = np.tile(np.eye(4), (len(distances), 1, 1))
    T_world_camera[:, 2, 3] = distances
    rng = np.random.default_rng(0)

    def image(n: int) -> np.ndarray:
        read.append(n)
        return rng.integers(0, 255, (32, 64, 3), dtype=np.uint8)

    return DepthRefiner(
        CAMERA, range(len(distances)), T_world_camera, image, DepthFusion("default").decide
    )


@pytest.mark.parametrize(("step_m", "expected"), [(1.0, {9, 10, 11, 12}), (0.1, {10, 3, 17, 30})])
def test_neighbours_are_chosen_by_their_distance(step_m: float, expected: set[int]):
    read: list[int] = []
    offset = 20 if step_m < 1 else 0
    assert refiner(np.arange(80) * step_m, read).refine(10 + offset, DEPTH) is not None
    assert {k - offset for k in read} == expected


def test_the_last_keyframe_has_its_neighbours_before_it():
    read: list[int] = []
    assert refiner(np.arange(20.0), read).refine(19, DEPTH) is not None
    assert set(read) == {17, 18, 19}


def test_what_is_unknown_begins_with_its_neighbours_and_is_not_believed_unmeasured():
    holes = DEPTH.copy()
    holes[10:20, 20:40] = 0
    holes[0, :2] = np.nan, np.inf
    refined = refiner(np.arange(20.0), []).refine(10, holes)
    assert refined is not None and np.isfinite(refined.depth).all() and (refined.depth > 0).all()
    unmeasured = ~(np.isfinite(holes) & (holes > 0)) & ~refined.measured
    assert unmeasured.any() and np.isinf(refined.relative_sigma[unmeasured]).all()
    assert np.isfinite(refined.relative_sigma[~unmeasured]).all()


def test_how_far_depth_is_fused_depends_on_its_sigma(monkeypatch):
    camera = Intrinsics(100, 50, 80.0, 80.0, 49.5, 24.5)
    depth = np.repeat(np.linspace(15, 40, 100, dtype=np.float32)[None], 50, axis=0)
    monkeypatch.setattr("slam.mapping.depth._MAX_DEPTH_RATIO", 10.0)
    config = MappingConfig(depth_max_m=20)
    image = np.full((50, 100, 3), 90, np.uint8)

    def farthest(relative_sigma: np.ndarray | None) -> float:
        view = KeyframeDepth(0, depth, relative_sigma, image, np.eye(4))
        return float(DepthFilters(config, camera).kept(view, ()).max())

    assert 19 < farthest(None) < 20 and 19 < farthest(np.full_like(depth, 0.1)) < 20
    assert 23 < farthest(np.full_like(depth, 0.05)) <= 24  # 0.05 of 24 m is 1.2 m
    assert 27 < farthest(np.full_like(depth, 0.02)) < 28
