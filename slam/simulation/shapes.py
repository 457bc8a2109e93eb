"""Simple bodies that objects are made of, their colours, frames and level rectangles of a plan."""

import numpy as np

from slam.simulation.geometry import FloatArray, Soup

UP = np.array([0.0, 0.0, 1.0])
Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1


def colour(
    rng: np.random.Generator, *choices: tuple[float, float, float], spread: float = 0.06
) -> FloatArray:
    """One of the given colours, a little off, ``(3,)``."""
    base = np.array(choices[rng.integers(len(choices))])
    return np.asarray(
        np.clip(base + rng.normal(0.0, spread) + rng.normal(0.0, 0.4 * spread, 3), 0.02, 1.0)
    )


def frame_at(x: float, y: float, angle: float, z: float = 0.0) -> FloatArray:
    """Frame at a place in the plan, its x axis turned by ``angle`` radians from east.

    Returns:
        The x, y and z axis and the origin as rows, ``(4, 3)``.
    """
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0], [x, y, z]])


def box(
    soup: Soup, frame: FloatArray, low: FloatArray, high: FloatArray, instance: int, top: int = -1
) -> None:
    """Four walls and a lid between two corners given in ``frame``; ``top`` may look different."""
    axis_x, axis_y, axis_z, origin = frame
    wx, wy, wz = high - low
    corner = origin + low @ frame[:3]
    soup.quad(corner, wx * axis_x, wz * axis_z, instance)
    soup.quad(corner + wx * axis_x, wy * axis_y, wz * axis_z, instance)
    soup.quad(corner + wx * axis_x + wy * axis_y, -wx * axis_x, wz * axis_z, instance)
    soup.quad(corner + wy * axis_y, -wy * axis_y, wz * axis_z, instance)
    soup.quad(corner + wz * axis_z, wx * axis_x, wy * axis_y, instance if top < 0 else top)


def solid(
    soup: Soup,
    frame: FloatArray,
    low: tuple[float, ...],
    size: tuple[float, ...],
    look: int,
    top: int = -1,
) -> None:
    """A box by its lowest corner and its size, closed below."""
    corner, extent = np.array(low), np.array(size)
    box(soup, frame, corner, corner + extent, look, top)
    if low[2] > 0.0:
        foot = frame[3] + corner @ frame[:3] + extent[1] * frame[1]
        soup.quad(foot, extent[0] * frame[0], -extent[1] * frame[1], look)


def plate(
    soup: Soup,
    frame: FloatArray,
    low: tuple[float, ...],
    size: tuple[float, ...],
    front: int,
    rest: int,
) -> None:
    """A box that shows ``front`` on the side that leaves the wall, a hair before the box."""
    solid(soup, frame, low, size, rest)
    corner = frame[3] + np.array([low[0] + size[0], low[1] + size[1] + 0.002, low[2]]) @ frame[:3]
    soup.quad(corner, -size[0] * frame[0], size[2] * frame[2], front)


def tube(
    soup: Soup, base: FloatArray, tip: FloatArray, radii: tuple[float, float], instance: int
) -> None:
    """Six-sided tapering tube from ``base`` to ``tip``, ``(3,)`` each."""
    axis = (tip - base) / np.linalg.norm(tip - base)
    side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.7 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    angle = np.linspace(0.0, 2.0 * np.pi, 7)
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other  # (7, 3)
    points = np.stack([base + radii[0] * ring, tip + radii[1] * ring])
    height = float(np.linalg.norm(tip - base))
    along = np.stack([angle * radii[0], angle * radii[0]])
    soup.patch(points, np.stack([along, np.array([[0.0] * 7, [height] * 7])], axis=2), instance)


def ball(
    soup: Soup, rng: np.random.Generator, centre: FloatArray, radii: FloatArray, instance: int
) -> None:
    """A lumpy ellipsoid of 6 x 9 faces."""
    polar, around = np.linspace(0.0, np.pi, 7), np.linspace(0.0, 2.0 * np.pi, 10)
    sin_polar = np.sin(polar)[:, None]
    up = np.cos(polar)[:, None] * np.ones(10)
    unit = np.stack([sin_polar * np.cos(around), sin_polar * np.sin(around), up], axis=2)
    lump = rng.uniform(0.75, 1.2, (7, 10, 1))
    lump[:, -1], lump[0], lump[-1] = lump[:, 0], 1.0, 1.0
    points = centre + unit * lump * radii
    uv = np.stack(
        [np.broadcast_to(around * radii[0], (7, 10)), np.tile(polar[:, None] * radii[2], 10)],
        axis=2,
    )
    soup.patch(points, uv, instance)


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
