"""Open land beside a country road or a motorway, and what stands between it and the road."""

import numpy as np

from slam.geometry.se3 import FloatArray
from slam.simulation import objects
from slam.simulation.options import StreetKind
from slam.simulation.route import KERB
from slam.simulation.shapes import Rectangle, Site, grid_over


def open_land(
    site: Site, kind: StreetKind, grass: int, inner: Rectangle, sides: list[bool]
) -> None:
    """Land that may rise beside the road to a bank, with trees, hedges, fences or barriers.

    Args:
        site: takes the surfaces.
        kind: of the streets around it.
        grass: the instance of the world's grass.
        inner: the land, in the plan.
        sides: which of its sides are at a street: south, east, north, west.
    """
    rng = site.rng
    rise, run = max(0.0, rng.uniform(-3.0, 5.0)), rng.uniform(3.0, 10.0)
    x0, y0, x1, y1 = inner

    def ground(x: FloatArray, y: FloatArray) -> FloatArray:
        inwards = np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y))
        part = np.clip(inwards / run, 0.0, 1.0)
        return np.asarray(KERB + rise * part * part * (3.0 - 2.0 * part))

    points = grid_over(inner, 0.0, 2.0)
    points[..., 2] = ground(points[..., 0], points[..., 1])
    crop = site.colour("crop")
    land = grass if rng.random() < 0.4 else site.instance("grass", crop, 0.6)
    site.patch(points, points[..., :2], land)
    wood = rng.choice([0.0, 1.0, 4.0, 10.0])  # trees in 100 square metres near the road
    for number in np.flatnonzero(sides):
        edge, length = site.side(inner, number)
        for _ in range(rng.poisson(0.15 * wood * length)):
            far = 15.0 * rng.random() ** 1.5
            spot = edge.moved(rng.uniform(0.0, length), far)
            sunk = float(ground(*spot.origin[:2])) - 0.2
            objects.tree(spot.moved(0.0, up=sunk), rng.uniform(1.0, min(13.0, 2.0 + 3.0 * far)))
        _edge(edge.moved(0.0, up=KERB), kind, length)


def _edge(site: Site, kind: StreetKind, length: float) -> None:
    """What stands between a road and the open land beside it."""
    luck = site.rng.random()
    if kind == "motorway":
        if luck < 0.75:
            objects.barrier(site, length, luck < 0.25)
        elif luck < 0.87:  # against the noise
            wall = site.instance("boards", "noise wall", 0.6, (0.5,))
            site.box((length, 0.3, site.rng.uniform(2.5, 5.0)), wall)
    elif luck < 0.3:
        objects.fence(site, length)
    elif luck < 0.6:
        objects.hedge(site, length)
    elif luck < 0.75:
        objects.barrier(site, length, False)
