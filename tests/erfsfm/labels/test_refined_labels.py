"""Labels from refined learned depth against the simulated world, whose depth and poses are exact."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.labels.many_views import in_camera_heights, label, refined_label, shrunk
from erfsfm.mvs.flow import Array, measure
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

AROUND = (-4, -2, -1, 1, 2, 4)
NEIGHBOURS = (-1, 1, 3)


@cache
def street() -> SimulatedStreet:
    return SimulatedStreet(SimulationOptions(frames=250, seed=703))


@cache
def grey(frame: int) -> NDArray[np.uint8]:
    return street().render(frame).image[..., 1].copy()


def motion(frame: int, others: tuple[int, ...]) -> NDArray[np.float64]:
    T = np.linalg.inv(street().T_world_camera[[frame + k for k in others]]) @ street().T_world_camera[frame]
    T[:, :3, 3] /= street().camera_height_m
    return np.asarray(T)


def truth(frame: int) -> Array:
    """Inverse depth in camera heights, 0 where it is unknown."""
    depth = street().depth(frame)
    return np.where(depth > 0, street().camera_height_m / np.maximum(depth, 1e-6), 0).astype(np.float32)


def blurred(frame: int) -> Array:
    """What a network might give, in a unit of its own."""
    return 7 * cv2.GaussianBlur(truth(frame), (0, 0), 4) ** np.float32(0.9) + np.float32(0.05)


def errors(bounds: tuple[Array, Array], true: Array) -> tuple[Array, float]:
    """Relative errors where the bounds are narrow, and the share of these pixels."""
    least, most = bounds
    narrow = (least > 0) & (most < 1.5 * least) & (true > 0)
    return np.abs(np.sqrt(least[narrow] * most[narrow]) / true[narrow] - 1), float(narrow.mean())


@pytest.mark.parametrize("frame", [60, 150])
def test_more_is_known_than_by_flow_alone_and_it_is_as_right(frame: int) -> None:
    around = [grey(frame + k) for k in AROUND]
    by_flow = measure(grey(frame), around, street().K, motion(frame, AROUND))
    learned = in_camera_heights(blurred(frame), by_flow)
    assert learned is not None
    near = [grey(frame + k) for k in NEIGHBOURS]
    bounds = refined_label(grey(frame), near, street().K, motion(frame, NEIGHBOURS), learned)
    refined, known = errors(bounds, truth(frame))
    plain, known_by_flow = errors(label(grey(frame), around, street().K, motion(frame, AROUND)), truth(frame))
    assert known > known_by_flow + 0.1
    assert refined.mean() < plain.mean() + 0.005
    least, most = bounds
    both = (least > 0) & np.isfinite(most) & (truth(frame) > 0)
    between = (0.98 * least[both] <= truth(frame)[both]) & (truth(frame)[both] <= 1.02 * most[both])
    assert between.mean() > 0.8


def test_the_unit_of_learned_depth_may_be_off_in_a_frame() -> None:
    near = [grey(60 + k) for k in NEIGHBOURS]
    middles = []
    for unit in (0.8, 1.0, 1.25):
        bounds = refined_label(
            grey(60), near, street().K, motion(60, NEIGHBOURS), np.float32(unit) * exact_with_sky(60)
        )
        error, known = errors(bounds, truth(60))
        assert known > 0.5
        middles.append(np.median(error))
    assert max(middles) < 0.02


def exact_with_sky(frame: int) -> Array:
    return np.maximum(truth(frame), np.float32(0.008))


def test_no_scale_where_flow_measures_nothing() -> None:
    blank = np.full((64, 128), 120, np.uint8)
    by_flow = measure(blank, [blank] * 2, street().K, motion(60, (-1, 1)))
    assert in_camera_heights(np.ones((64, 128), np.float32), by_flow) is None


def test_a_smaller_label_is_wide_at_edges_and_unknown_where_a_pixel_is():
    least = np.full((2, 6), 0.2, np.float32)
    most = np.full((2, 6), 0.22, np.float32)
    least[:, 3], most[:, 3] = 0.02, 0.022  # a surface ten times as far in half of a block
    least[0, 5] = 0
    low, high = shrunk(least, most, 2)
    np.testing.assert_allclose([low[0, 0], high[0, 0]], [0.2, 0.22], rtol=1e-5)
    assert low[0, 1] < 0.021
    assert high[0, 1] > 0.21
    assert low[0, 2] == 0
    np.testing.assert_allclose(high[0, 2], 0.22, rtol=1e-5)
