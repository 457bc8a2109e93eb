"""Open land beside a country road or a motorway, and what stands between it and the road."""

import numpy as np

from slam.simulation import objects
from slam.simulation.geometry import FloatArray, Material, Soup
from slam.simulation.options import StreetKind
from slam.simulation.route import KERB
from slam.simulation.shapes import (
    Rectangle,
    ball,
    box,
    colour,
    corners_of,
    directed,
    frame_at,
    grid_over,
)


def open_land(
    soup: Soup,
    rng: np.random.Generator,
    kind: StreetKind,
    grass: int,
    inner: Rectangle,
    sides: list[bool],
) -> None:
    """Land that may rise beside the road to a bank, with trees, bushes, hedges, fences or barriers.

    Args:
        soup: takes the surfaces.
        rng: draws what stands where.
        kind: of the streets around it.
        grass: the instance of the world's grass.
        inner: the land, in the plan.
        sides: which of its sides are at a street: south, east, north, west.
    """
    rise = max(0.0, float(rng.uniform(-3.0, 5.0)))
    run = float(rng.uniform(3.0, 10.0))
    low = np.array(inner[:2])
    high = np.array(inner[2:])

    def ground(x: FloatArray, y: FloatArray) -> FloatArray:
        inwards = np.minimum(
            np.minimum(x - low[0], high[0] - x), np.minimum(y - low[1], high[1] - y)
        )
        part = np.clip(inwards / run, 0.0, 1.0)
        return np.asarray(KERB + rise * part * part * (3.0 - 2.0 * part))

    points = grid_over(inner, 0.0, 2.0)
    points[..., 2] = ground(points[..., 0], points[..., 1])
    crop = colour(
        rng, (0.30, 0.36, 0.14), (0.55, 0.47, 0.26), (0.34, 0.27, 0.20), (0.24, 0.34, 0.13)
    )
    land = grass if rng.random() < 0.4 else soup.instance(Material.GRASS, crop, 0.6 * crop)
    soup.patch(points, points[..., :2], land)
    wood = float(rng.choice([0.0, 1.0, 4.0, 10.0]))  # trees in 100 square metres near the road
    corners = corners_of(inner)
    for side in np.flatnonzero(sides):
        start = corners[side]
        length, ahead, inward, angle = directed(start, corners[(side + 1) % 4])
        frame = frame_at(start[0], start[1], angle, KERB)
        for _ in range(int(rng.poisson(0.15 * wood * length))):
            far = 15.0 * rng.random() ** 1.5
            x, y = start + rng.uniform(0.0, length) * ahead + far * inward
            z = float(ground(np.array(x), np.array(y)))
            if rng.random() < 0.4:
                green = colour(
                    rng, (0.20, 0.30, 0.12), (0.32, 0.34, 0.16), (0.14, 0.24, 0.10), spread=0.03
                )
                bush = soup.instance(Material.LEAVES, green, 0.45 * green)
                size = float(rng.uniform(0.5, 1.8))
                ball(
                    soup,
                    rng,
                    np.array([x, y, z + 0.4 * size]),
                    np.array([1.0, 1.0, 0.8]) * size,
                    bush,
                )
            elif far > 1.5:
                objects.tree(soup, rng, float(x), float(y), float(rng.uniform(4.0, 13.0)), z - 0.2)
        _edge(soup, rng, kind, frame, length)


def _edge(
    soup: Soup, rng: np.random.Generator, kind: StreetKind, frame: FloatArray, length: float
) -> None:
    """What stands between a road and the open land beside it."""
    luck = rng.random()
    if kind == "motorway":
        if luck < 0.75:
            objects.barrier(soup, rng, frame, length, luck < 0.25)
        elif luck < 0.87:  # against the noise
            stone = colour(rng, (0.55, 0.53, 0.48), (0.40, 0.45, 0.40), (0.45, 0.38, 0.30))
            wall = soup.instance(Material.BOARDS, stone, 0.6 * stone, (0.5,))
            box(
                soup,
                frame,
                np.zeros(3),
                np.array([length, 0.3, float(rng.uniform(2.5, 5.0))]),
                wall,
            )
    elif luck < 0.3:
        objects.wire_fence(soup, rng, frame, length)
    elif luck < 0.4:
        objects.hedge(soup, rng, frame, length)
    elif luck < 0.6:
        for along in np.arange(3.0, length, float(rng.uniform(7.0, 14.0))):
            x, y, _ = frame[3] + along * frame[0] + 0.5 * frame[1]
            objects.tree(soup, rng, float(x), float(y), float(rng.uniform(6.0, 12.0)))
    elif luck < 0.75:
        objects.barrier(soup, rng, frame, length, False)
