"""A simulated street as the makers of labels see it, and its exact inverse depth in camera heights."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from erfsfm.mvs.views import Array
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

FRAME = 60


@cache
def long_street() -> SimulatedStreet:
    return SimulatedStreet(SimulationOptions(frames=250, seed=703))


@cache
def grey(frame: int) -> NDArray[np.uint8]:
    return long_street().render(frame)[..., 1].copy()


def seen(
    frame: int, others: tuple[int, ...]
) -> tuple[NDArray[np.uint8], list[NDArray[np.uint8]], Array, Array]:
    """A frame, its neighbours, their camera, and ``T_neighbour_target`` in camera heights."""
    T = (
        np.linalg.inv(long_street().T_world_camera[[frame + k for k in others]])
        @ long_street().T_world_camera[frame]
    )
    T[:, :3, 3] /= long_street().camera_height_m
    return grey(frame), [grey(frame + k) for k in others], long_street().K, T


@cache
def truth(frame: int) -> Array:
    """Inverse depth in camera heights, 0 where it is unknown."""
    depth = long_street().depth(frame)
    return np.where(depth > 0, long_street().camera_height_m / np.maximum(depth, 1e-6), 0).astype(
        np.float32
    )


def errors(bounds: tuple[Array, Array], true: Array) -> tuple[Array, float]:
    """Relative errors where the bounds are narrow, and the share of these pixels."""
    least, most = bounds
    narrow = (least > 0) & (most < 1.5 * least) & (true > 0)
    return np.abs(np.sqrt(least[narrow] * most[narrow]) / true[narrow] - 1), float(narrow.mean())
