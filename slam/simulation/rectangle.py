"""Level rectangles of a plan: their vertices, corners and sides."""

import numpy as np

from slam.simulation.geometry import FloatArray
from slam.simulation.shapes import frame_at

Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1


def grid_over(rectangle: Rectangle, z: float, step: float) -> FloatArray:
    """Vertices over a rectangle about ``step`` metres apart, ``(R, C, 3)``."""
    x0, y0, x1, y1 = rectangle
    x = np.linspace(x0, x1, max(1, int((x1 - x0) / step)) + 1)
    y = np.linspace(y0, y1, max(1, int((y1 - y0) / step)) + 1)
    gx, gy = np.meshgrid(x, y)
    return np.stack([gx, gy, np.full_like(gx, z)], axis=2)


def corners_of(rectangle: Rectangle) -> FloatArray:
    """South west, south east, north east and north west, ``(4, 2)``."""
    x0, y0, x1, y1 = rectangle
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def frame_along(rectangle: Rectangle, number: int, z: float) -> FloatArray:
    """Frame along a side, counterclockwise from the south."""
    x, y = corners_of(rectangle)[number]
    return frame_at(x, y, number * np.pi / 2.0, z)


def directed(start: FloatArray, end: FloatArray) -> tuple[float, FloatArray, FloatArray, float]:
    """How an edge in the plan runs.

    Returns:
        Its length, its direction ``(2,)``, the one to its left and its angle from east.
    """
    length = float(np.linalg.norm(end - start))
    ahead = (end - start) / max(length, 1e-9)
    return length, ahead, np.array([-ahead[1], ahead[0]]), float(np.arctan2(ahead[1], ahead[0]))
