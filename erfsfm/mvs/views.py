"""Views: which of a drive measure the depth of one of them, where the pixels of one lie in another, and how they look.

A view that measures is about as far away as gives parallax, and turned little.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
Array = NDArray[np.float32]

NEIGHBOURHOOD_PX = 2.0  # standard deviation of the Gaussian window
CONTRAST_FLOOR = 2.0  # grey levels: what is less is noise

BASELINES = (0.07, 0.2)  # wanted distances over the median depth
_RANGE = 2.5  # accepted factor on these
_LARGEST_TURN_DEG = 20.0
_MOST_NEIGHBOURS = 3
_MAX_FRAMES_APART = 40
LEAST_Z = 1e-3


@dataclass(frozen=True)
class Appearance:
    """A grey image ``(H, W)``: its levels, plain and normalised.

    ``slopes`` are the derivatives of the normalised ones along x and y.
    """

    grey: Array
    levels: Array
    slopes: tuple[Array, Array]

    @classmethod
    def of(cls, grey: Grey) -> Appearance:
        """Normalise a grey image ``(H, W)``."""
        full = grey.astype(np.float32)
        levels = normalised(full)
        along_x = cv2.Sobel(levels, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
        along_y = cv2.Sobel(levels, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
        return cls(full, levels, (np.asarray(along_x), np.asarray(along_y)))


def normalised(grey: Array) -> Array:
    """Grey levels ``(H, W)`` minus their local mean, over their local standard deviation."""
    mean = cv2.GaussianBlur(grey, (0, 0), NEIGHBOURHOOD_PX)
    variance = cv2.GaussianBlur(grey * grey, (0, 0), NEIGHBOURHOOD_PX) - mean * mean
    return (grey - mean) / (np.sqrt(np.maximum(variance, 0)) + np.float32(CONTRAST_FLOOR))


def neighbours(
    T_world_camera: NDArray[np.float64], target: int, wanted: Iterable[float]
) -> list[int]:
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
    T_world_camera: NDArray[np.float64],
    target: int,
    median_depth: float,
    frames: Sequence[int] | NDArray[np.int64],
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


class Projection:
    """``K (R p + d t)`` for all pixels p of an image, with the rotated rays computed once."""

    def __init__(
        self,
        K: NDArray[np.floating],
        T_neighbour_target: NDArray[np.floating],
        height: int,
        width: int,
    ) -> None:
        H = (K @ T_neighbour_target[:3, :3] @ np.linalg.inv(K)).astype(np.float32)
        u, v = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
        self._rotated = [
            H[row, 0] * u + H[row, 1] * v + H[row, 2] for row in range(3)
        ]  # (H, W) each
        self._moved = (K @ T_neighbour_target[:3, 3]).astype(np.float32)

    def pixels(self, inverse_depth: Array) -> tuple[Array, Array, Array]:
        """Columns, rows and z over the depth, ``(H, W)`` each."""
        x, y, z = (
            cv2.scaleAdd(inverse_depth, float(m), r)
            for r, m in zip(self._rotated, self._moved, strict=True)
        )
        z = cv2.max(z, LEAST_Z)
        return x / z, y / z, z

    def motion(self, u: Array, v: Array, z: Array, inverse_depth: Array) -> tuple[Array, Array]:
        """Derivatives of columns and rows with respect to the logarithm of the inverse depth."""
        k = inverse_depth / z
        moved = self._moved
        return (moved[0] - u * moved[2]) * k, (moved[1] - v * moved[2]) * k
