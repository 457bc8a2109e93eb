"""Furniture of boxes, and which pieces stand at the walls of each kind of room.

Each piece stands on a frame whose x axis runs along a wall and whose y axis leaves it.
"""

from collections.abc import Callable
from itertools import product

import numpy as np

from slam.simulation.geometry import FloatArray, Material, Soup
from slam.simulation.shapes import ball, colour, plate, solid

Pair = tuple[float, float]
Piece = Callable[[Soup, np.random.Generator, FloatArray, float], None]

WOODS = (
    (0.50, 0.34, 0.20),
    (0.68, 0.52, 0.34),
    (0.82, 0.80, 0.76),
    (0.30, 0.21, 0.15),
    (0.60, 0.42, 0.28),
)
CLOTHS = (
    (0.25, 0.32, 0.45),
    (0.55, 0.30, 0.25),
    (0.42, 0.44, 0.42),
    (0.62, 0.56, 0.45),
    (0.24, 0.38, 0.32),
)
PAINTS = (
    (0.70, 0.20, 0.16),
    (0.15, 0.35, 0.60),
    (0.85, 0.68, 0.20),
    (0.20, 0.48, 0.36),
    (0.85, 0.82, 0.76),
)


def wood(soup: Soup, rng: np.random.Generator, *door: float) -> int:
    """A wood or a painted board; ``door`` is the width and height of its doors."""
    return soup.instance(Material.WOOD, colour(rng, *WOODS), np.array([0.75, 0.74, 0.70]), door)


def shelf(soup: Soup, rng: np.random.Generator, frame: FloatArray, width: float) -> None:
    """Books to above the eyes."""
    height, tone = float(rng.uniform(1.7, 2.1)), colour(rng, *WOODS)
    books = soup.instance(
        Material.BOOKS, tone, None, (width, height, height / float(rng.integers(5, 8)))
    )
    plate(soup, frame, (0, 0, 0), (width, 0.3, height), books, soup.instance(Material.WOOD, tone))


def cupboard(soup: Soup, rng: np.random.Generator, frame: FloatArray, width: float) -> None:
    """Doors with knobs."""
    height = float(rng.uniform(1.8, 2.1))
    solid(soup, frame, (0, 0, 0), (width, 0.55, height), wood(soup, rng, width / 2.0, height))


def chest(soup: Soup, rng: np.random.Generator, frame: FloatArray, width: float) -> None:
    """Drawers with a few things on them."""
    height = float(rng.uniform(0.7, 0.95))
    solid(
        soup,
        frame,
        (0, 0, 0),
        (width, 0.42, height),
        wood(soup, rng, width / 2.0, height / 3.0),
        wood(soup, rng),
    )
    _things(soup, rng, frame, width, 0.4, height)


def desk(soup: Soup, rng: np.random.Generator, frame: FloatArray, width: float) -> None:
    """A table with a screen and its keyboard."""
    _table(soup, rng, frame, width, 0.65)
    dark = soup.instance(Material.FABRIC, np.array([0.08, 0.08, 0.09]))
    across, high = 0.56, 0.34
    shown = soup.instance(Material.SCREEN, np.ones(3), colour(rng, *CLOTHS), (across, high))
    left = float(rng.uniform(0.1, max(width - across - 0.1, 0.12)))
    plate(soup, frame, (left, 0.15, 0.85), (across, 0.04, high), shown, dark)
    solid(soup, frame, (left + 0.24, 0.14, 0.73), (0.08, 0.06, 0.14), dark)
    solid(soup, frame, (left + 0.08, 0.4, 0.73), (0.42, 0.14, 0.02), dark)
    _things(soup, rng, frame, left, 0.6, 0.73)


def counter(soup: Soup, rng: np.random.Generator, frame: FloatArray, width: float) -> None:
    """A kitchen's worktop with tiles above it."""
    stone = soup.instance(Material.FABRIC, colour(rng, (0.3, 0.3, 0.31), (0.7, 0.68, 0.64)))
    solid(
        soup,
        frame,
        (0, 0, 0),
        (width, 0.6, 0.86),
        wood(soup, rng, width / np.ceil(width / 0.6), 0.86),
    )
    solid(soup, frame, (0, 0, 0.86), (width, 0.63, 0.04), stone)
    tiles = soup.instance(
        Material.TILES, colour(rng, *PAINTS, (0.9, 0.9, 0.88)), np.full(3, 0.75), (0.15, 0.008)
    )
    plate(soup, frame, (0, 0, 0.9), (width, 0.015, 0.6), tiles, stone)
    solid(
        soup,
        frame,
        (0, 0, 1.5),
        (width, 0.33, 0.6),
        wood(soup, rng, width / np.ceil(width / 0.6), 0.6),
    )
    _things(soup, rng, frame, width, 0.55, 0.9)


def sofa(soup: Soup, rng: np.random.Generator, frame: FloatArray, width: float) -> None:
    """A seat, a back and two arms."""
    cloth = soup.instance(Material.FABRIC, colour(rng, *CLOTHS))
    solid(soup, frame, (0, 0, 0), (width, 0.65, 0.42), cloth)
    solid(soup, frame, (0, 0, 0.42), (width, 0.2, 0.4), cloth)
    for left in (0.0, width - 0.16):
        solid(soup, frame, (left, 0, 0.42), (0.16, 0.65, 0.18), cloth)
    pillow = soup.instance(
        Material.CARPET, colour(rng, *PAINTS), colour(rng, *PAINTS), (0.4, 0.36, 0.11)
    )
    plate(soup, frame, (0.3, 0.2, 0.43), (0.4, 0.1, 0.36), pillow, cloth)


def bed(soup: Soup, rng: np.random.Generator, frame: FloatArray, width: float) -> None:
    """A bed along the wall, with a pillow and a pattern on its cover."""
    cover = soup.instance(
        Material.CARPET, colour(rng, *CLOTHS), colour(rng, *PAINTS), (width, 0.65, 0.3)
    )
    solid(soup, frame, (0, 0, 0), (width, 0.65, 0.35), wood(soup, rng), cover)
    solid(
        soup,
        frame,
        (0.05, 0.06, 0.35),
        (0.45, 0.52, 0.12),
        soup.instance(Material.FABRIC, np.full(3, 0.85)),
    )


def plant(soup: Soup, rng: np.random.Generator, frame: FloatArray, width: float) -> None:
    """Leaves in a pot."""
    solid(
        soup,
        frame,
        (0.15, 0.1, 0),
        (0.3, 0.3, 0.35),
        soup.instance(Material.FABRIC, colour(rng, *PAINTS)),
    )
    leaf = colour(rng, (0.15, 0.30, 0.12), (0.25, 0.36, 0.16), spread=0.03)
    leaves = soup.instance(Material.LEAVES, leaf, 0.4 * leaf)
    centre = frame[3] + np.array([0.3, 0.28, 0.75]) @ frame[:3]
    ball(soup, rng, centre, np.array([-0.22, 0.22, 0.4]), leaves)


def cartons(
    soup: Soup,
    rng: np.random.Generator,
    frame: FloatArray,
    width: float,
    depth: float = 0.6,
    levels: int = 3,
) -> None:
    """A stack of cartons of several sizes."""
    height = 0.0
    for _ in range(int(rng.integers(1, levels + 1))):
        high, left = float(rng.uniform(0.3, 0.65)), 0.0
        while width - left > 0.25:
            wide = min(float(rng.uniform(0.3, 0.8)), width - left)
            deep = depth * float(rng.uniform(0.8, 1.0))
            paint = colour(
                rng, (0.62, 0.46, 0.30), (0.55, 0.40, 0.26), (0.72, 0.68, 0.62), spread=0.04
            )
            look = soup.instance(Material.CARTON, paint, colour(rng, *PAINTS), (wide, high))
            solid(
                soup,
                frame,
                (left, 0, height),
                (wide - 0.01, deep, high * float(rng.uniform(0.75, 1.0))),
                look,
            )
            left += wide
        height += high


def rack(soup: Soup, rng: np.random.Generator, frame: FloatArray, width: float) -> None:
    """Cartons on three boards between posts."""
    steel = soup.instance(Material.METAL, colour(rng, *PAINTS))
    _legs(soup, frame, (0.0, width - 0.06), (0.0, 0.54), (0.06, 0.06, 2.6), steel)
    for level in (0.15, 0.95, 1.75):
        solid(soup, frame, (0, 0, level), (width, 0.6, 0.05), steel)
        raised = frame.copy()
        raised[3] += (level + 0.05) * frame[2] + 0.08 * frame[0]
        cartons(soup, rng, raised, (width - 0.16) * float(rng.uniform(0.4, 1.0)), 0.55, 1)


def dining(
    soup: Soup, rng: np.random.Generator, frame: FloatArray, width: float, depth: float
) -> None:
    """A table with chairs on two sides."""
    _table(soup, rng, frame, width, depth)
    _things(soup, rng, frame, width, depth, 0.73)
    seat = wood(soup, rng)
    for left in np.arange(0.15, width - 0.5, 0.65).tolist():
        for front, back in ((-0.25, -0.29), (depth - 0.2, depth + 0.21)):
            solid(soup, frame, (left, front, 0.42), (0.42, 0.45, 0.04), seat)
            solid(soup, frame, (left, back, 0.42), (0.42, 0.04, 0.5), seat)
            _legs(soup, frame, (left, left + 0.38), (front, front + 0.41), (0.04, 0.04, 0.42), seat)


def _table(
    soup: Soup, rng: np.random.Generator, frame: FloatArray, width: float, depth: float
) -> None:
    board = wood(soup, rng)
    solid(soup, frame, (0, 0, 0.69), (width, depth, 0.04), board)
    _legs(soup, frame, (0.02, width - 0.08), (0.02, depth - 0.08), (0.06, 0.06, 0.69), board)


def _legs(
    soup: Soup, frame: FloatArray, xs: Pair, ys: Pair, size: tuple[float, float, float], look: int
) -> None:
    for x, y in product(xs, ys):
        solid(soup, frame, (x, y, 0), size, look)


def _things(
    soup: Soup,
    rng: np.random.Generator,
    frame: FloatArray,
    width: float,
    depth: float,
    height: float,
) -> None:
    """Small boxes on a board."""
    left = float(rng.uniform(0.05, 0.3))
    while left < width - 0.2:
        size = tuple(float(side) for side in rng.uniform((0.06, 0.06, 0.03), (0.2, 0.2, 0.3)))
        look = soup.instance(
            Material.CARTON, colour(rng, *PAINTS), colour(rng, *PAINTS), (size[0], size[2])
        )
        solid(
            soup,
            frame,
            (left, float(rng.uniform(0.03, max(depth - 0.22, 0.04))), height),
            size,
            look,
        )
        left += size[0] + float(rng.uniform(0.05, 0.7))


# of each kind of room: what may stand at its walls
STANDING: dict[str, tuple[tuple[Piece, float, float], ...]] = {  # piece, its width and depth
    "living": (
        (sofa, 1.9, 0.65),
        (shelf, 1.2, 0.3),
        (chest, 1.3, 0.42),
        (plant, 0.6, 0.6),
        (shelf, 0.9, 0.3),
    ),
    "kitchen": (
        (counter, 2.4, 0.63),
        (cupboard, 1.1, 0.55),
        (counter, 1.8, 0.63),
        (chest, 1.0, 0.42),
    ),
    "office": (
        (desk, 1.4, 0.65),
        (shelf, 1.0, 0.3),
        (desk, 1.6, 0.65),
        (cupboard, 0.9, 0.55),
        (plant, 0.6, 0.6),
    ),
    "bedroom": ((bed, 2.0, 0.65), (cupboard, 1.6, 0.55), (chest, 0.9, 0.42), (desk, 1.2, 0.65)),
    "bath": ((chest, 1.0, 0.42), (cupboard, 0.7, 0.55)),
    "corridor": ((plant, 0.6, 0.6), (shelf, 0.8, 0.3)),
    "hall": ((rack, 2.4, 0.6), (cartons, 1.4, 0.6), (rack, 1.8, 0.6)),
}
TALL: tuple[Piece, ...] = (shelf, cupboard, counter, rack)  # hide what hangs on the wall
