"""Furniture of boxes, and which pieces stand at the walls of each kind of room.

Each piece stands at a place whose x axis runs along a wall and whose y axis leaves it.
"""

from collections.abc import Callable
from itertools import product

import numpy as np

from slam.simulation.shapes import Site

Pair = tuple[float, float]
# builds at a place in a width, metres, and says how deep it stands
Piece = Callable[[Site, float], float]


def wood(site: Site, *door: float) -> int:
    """A wood or a painted board; ``door`` is the width and height of its doors."""
    return site.instance("wood", "wood", (0.75, 0.74, 0.70), door)


def shelf(site: Site, width: float) -> float:
    """Books to above the eyes."""
    height, tone = site.rng.uniform(1.7, 2.1), site.colour("wood")
    rows = (width, height, height / site.rng.integers(5, 8))
    books = site.instance("books", tone, 1.0, rows)
    site.plate((0, 0, 0), (width, 0.3, height), books, site.instance("wood", tone))
    return 0.3


def cupboard(site: Site, width: float) -> float:
    """Doors with knobs."""
    height = site.rng.uniform(1.8, 2.1)
    site.box((width, 0.55, height), wood(site, width / 2.0, height))
    return 0.55


def chest(site: Site, width: float) -> float:
    """Drawers with a few things on them."""
    height = site.rng.uniform(0.7, 0.95)
    drawers = wood(site, width / 2.0, height / 3.0)
    site.box((width, 0.42, height), drawers, top=wood(site))
    _things(site, width, 0.4, height)
    return 0.42


def desk(site: Site, width: float) -> float:
    """A table with a screen and its keyboard."""
    _table(site, width, 0.65)
    dark = site.instance("fabric", (0.08, 0.08, 0.09))
    across, high = 0.56, 0.34
    shown = site.instance("screen", np.ones(3), "cloth", (across, high))
    left = site.rng.uniform(0.1, max(width - across - 0.1, 0.12))
    site.plate((left, 0.15, 0.85), (across, 0.04, high), shown, dark)
    site.box((0.08, 0.06, 0.14), dark, (left + 0.24, 0.14, 0.73))
    site.box((0.42, 0.14, 0.02), dark, (left + 0.08, 0.4, 0.73))
    _things(site, left, 0.6, 0.73)
    return 0.65


def counter(site: Site, width: float) -> float:
    """A kitchen's worktop with tiles above it."""
    stone = site.instance("fabric", "worktop")
    door = width / np.ceil(width / 0.6)
    site.box((width, 0.6, 0.86), wood(site, door, 0.86))
    site.box((width, 0.63, 0.04), stone, (0, 0, 0.86))
    tiles = site.instance("tiles", "kitchen tiles", np.full(3, 0.75), (0.15, 0.008))
    site.plate((0, 0, 0.9), (width, 0.015, 0.6), tiles, stone)
    site.box((width, 0.33, 0.6), wood(site, door, 0.6), (0, 0, 1.5))
    _things(site, width, 0.55, 0.9)
    return 0.63


def sofa(site: Site, width: float) -> float:
    """A seat, a back and two arms."""
    cloth = site.instance("fabric", "cloth")
    site.box((width, 0.65, 0.42), cloth)
    site.box((width, 0.2, 0.4), cloth, (0, 0, 0.42))
    for left in (0.0, width - 0.16):
        site.box((0.16, 0.65, 0.18), cloth, (left, 0, 0.42))
    pillow = site.instance("carpet", "paint", "paint", (0.4, 0.36, 0.11))
    site.plate((0.3, 0.2, 0.43), (0.4, 0.1, 0.36), pillow, cloth)
    return 0.65


def bed(site: Site, width: float) -> float:
    """A bed along the wall, with a pillow and a pattern on its cover."""
    cover = site.instance("carpet", "cloth", "paint", (width, 0.65, 0.3))
    site.box((width, 0.65, 0.35), wood(site), top=cover)
    pillow = site.instance("fabric", np.full(3, 0.85))
    site.box((0.45, 0.52, 0.12), pillow, (0.05, 0.06, 0.35))
    return 0.65


def plant(site: Site, width: float) -> float:
    """Leaves in a pot."""
    site.box((0.3, 0.3, 0.35), site.instance("fabric", "paint"), (0.15, 0.1, 0))
    leaves = site.instance("leaves", "house plant", 0.4)
    site.ball(site.origin + (0.3, 0.28, 0.75) @ site.frame[:3], (-0.22, 0.22, 0.4), leaves)
    return 0.6


def cartons(site: Site, width: float, depth: float = 0.6, levels: int = 3) -> float:
    """A stack of cartons of several sizes."""
    rng, height = site.rng, 0.0
    for _ in range(rng.integers(1, levels + 1)):
        high, left = rng.uniform(0.3, 0.65), 0.0
        while width - left > 0.25:
            wide = min(rng.uniform(0.3, 0.8), width - left)
            deep = depth * rng.uniform(0.8, 1.0)
            look = site.instance("carton", "carton", "paint", (wide, high))
            size = (wide - 0.01, deep, high * rng.uniform(0.75, 1.0))
            site.box(size, look, (left, 0, height))
            left += wide
        height += high
    return depth


def rack(site: Site, width: float) -> float:
    """Cartons on three boards between posts."""
    steel = site.instance("metal", "paint")
    _legs(site, (0.0, width - 0.06), (0.0, 0.54), (0.06, 0.06, 2.6), steel)
    for level in (0.15, 0.95, 1.75):
        site.box((width, 0.6, 0.05), steel, (0, 0, level))
        raised = site.moved(0.08, up=level + 0.05)
        cartons(raised, (width - 0.16) * site.rng.uniform(0.4, 1.0), 0.55, 1)
    return 0.6


def dining(site: Site, width: float, depth: float) -> None:
    """A table with chairs on two sides."""
    _table(site, width, depth)
    _things(site, width, depth, 0.73)
    seat = wood(site)
    for left in np.arange(0.15, width - 0.5, 0.65).tolist():
        for front, back in ((-0.25, -0.29), (depth - 0.2, depth + 0.21)):
            site.box((0.42, 0.45, 0.04), seat, (left, front, 0.42))
            site.box((0.42, 0.04, 0.5), seat, (left, back, 0.42))
            _legs(site, (left, left + 0.38), (front, front + 0.41), (0.04, 0.04, 0.42), seat)


def _table(site: Site, width: float, depth: float) -> None:
    board = wood(site)
    site.box((width, depth, 0.04), board, (0, 0, 0.69))
    _legs(site, (0.02, width - 0.08), (0.02, depth - 0.08), (0.06, 0.06, 0.69), board)


def _legs(site: Site, xs: Pair, ys: Pair, size: tuple[float, ...], look: int) -> None:
    for x, y in product(xs, ys):
        site.box(size, look, (x, y, 0))


def _things(site: Site, width: float, depth: float, height: float) -> None:
    """Small boxes on a board."""
    rng = site.rng
    left = rng.uniform(0.05, 0.3)
    while left < width - 0.2:
        size = tuple(rng.uniform((0.06, 0.06, 0.03), (0.2, 0.2, 0.3)).tolist())
        look = site.instance("carton", "paint", "paint", size[::2])
        site.box(size, look, (left, rng.uniform(0.03, max(depth - 0.22, 0.04)), height))
        left += size[0] + rng.uniform(0.05, 0.7)


# of each kind of room: what may stand at its walls, and its width
STANDING: dict[str, tuple[tuple[Piece, float], ...]] = {
    "living": ((sofa, 1.9), (shelf, 1.2), (chest, 1.3), (plant, 0.6), (shelf, 0.9)),
    "kitchen": ((counter, 2.4), (cupboard, 1.1), (counter, 1.8), (chest, 1.0)),
    "office": ((desk, 1.4), (shelf, 1.0), (desk, 1.6), (cupboard, 0.9), (plant, 0.6)),
    "bedroom": ((bed, 2.0), (cupboard, 1.6), (chest, 0.9), (desk, 1.2)),
    "bath": ((chest, 1.0), (cupboard, 0.7)),
    "corridor": ((plant, 0.6), (shelf, 0.8)),
    "hall": ((rack, 2.4), (cartons, 1.4), (rack, 1.8)),
}
TALL: tuple[Piece, ...] = (shelf, cupboard, counter, rack)  # hide what hangs on the wall
