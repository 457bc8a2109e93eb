"""A furnished house: rooms on both sides of a corridor, a hall at its end, their surfaces, lamps and furniture.

Furniture is of boxes; each piece stands on a frame whose x axis runs along a wall and whose y axis leaves it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from slam.simulation.geometry import FLAT, FloatArray, Material, Soup
from slam.simulation.objects import ball, box, colour, frame_at

Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1
Pair = tuple[float, float]
Piece = Callable[[Soup, np.random.Generator, FloatArray, float], None]

WALL = 0.14  # thickness, metres
DOOR_HEIGHT = 2.1
KINDS = ("living", "kitchen", "office", "bedroom", "bath", "office")
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
_WALLS = (
    (0.86, 0.84, 0.79),
    (0.80, 0.82, 0.84),
    (0.78, 0.72, 0.60),
    (0.66, 0.72, 0.68),
    (0.74, 0.62, 0.56),
)
_AISLE = 1.0  # left free between the furniture at the walls and the table in the middle, metres
_DEEPEST = 0.65  # piece at a wall, metres
_STEP = 0.5  # between the vertices of walls, which carry the light, metres


@dataclass(frozen=True)
class Room:
    """A room between its walls; x east, y north, metres."""

    kind: str  # one of KINDS, corridor or hall
    area: Rectangle  # of its floor
    height: float  # of its ceiling
    outside: tuple[int, ...]  # sides with daylight: 0 south, 1 east, 2 north, 3 west

    def contains(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which points of the plan ``(N, 2)`` are inside, ``(N,)``."""
        x0, y0, x1, y1 = self.area
        return np.asarray(((points > (x0, y0)) & (points < (x1, y1))).all(axis=1))

    def side(self, number: int) -> tuple[tuple[float, float], float, float]:
        """Where a wall begins, counterclockwise, its direction as an angle, and its length."""
        x0, y0, x1, y1 = self.area
        corner = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))[number]
        return corner, number * np.pi / 2.0, x1 - x0 if number % 2 == 0 else y1 - y0


@dataclass(frozen=True)
class House:
    """Rooms, and doorways as the rectangles of the walls that they cut."""

    rooms: list[Room]
    doors: list[Rectangle]

    def openings(self, room: Room, number: int) -> list[tuple[float, float]]:
        """Where the doors in a wall of a room begin and end along it, in order."""
        x0, y0, x1, y1 = room.area
        found = []
        for left, low, right, high in self.doors:
            spans = (
                (left - x0, right - x0),
                (low - y0, high - y0),
                (x1 - right, x1 - left),
                (y1 - high, y1 - low),
            )
            touches = (high == y0, left == x1, low == y1, right == x0)[number]
            along = spans[number]
            if touches and along[0] > 0.0 and along[1] < room.side(number)[2]:
                found.append(along)
        return sorted(found)


def draw_house(seed: int) -> House:
    """The plan of a world."""
    rng = np.random.default_rng([seed, 50])
    length, width = float(rng.uniform(14.0, 20.0)), float(rng.uniform(1.9, 2.4))
    height = float(rng.uniform(2.45, 2.9))
    corridor = Room("corridor", (0.0, 0.0, length, width), height, (3,))
    wide, deep = float(rng.uniform(9.0, 13.0)), float(rng.uniform(7.5, 10.0))
    hall_x, hall_y = length + WALL, 0.5 * width - deep * float(rng.uniform(0.35, 0.65))
    hall = Room(
        "hall",
        (hall_x, hall_y, hall_x + wide, hall_y + deep),
        float(rng.uniform(3.8, 5.0)),
        (0, 1, 2),
    )
    rooms, doors = [corridor, hall], [(length, 0.5 * width - 0.8, hall_x, 0.5 * width + 0.8)]
    kinds = list(rng.permutation(KINDS)) + list(rng.permutation(KINDS))
    for north in (False, True):
        start, before = 0.0, None
        while length - start > 3.2:
            end = start + float(rng.uniform(3.4, 6.0))
            end = length if length - end < 3.4 + WALL else end
            depth = float(rng.uniform(3.4, 5.5))
            low, high = (width + WALL, width + WALL + depth) if north else (-WALL - depth, -WALL)
            rooms.append(
                Room(str(kinds.pop()), (start, low, end, high), height, (2,) if north else (0,))
            )
            door = start + float(rng.uniform(0.75, end - start - 1.85))
            opening = float(rng.uniform(0.95, 1.1))
            doors.append(
                (door, width, door + opening, low) if north else (door, -WALL, door + opening, 0.0)
            )
            if before is not None and rng.random() < 0.5:
                middle = width + WALL + 1.2 if north else -WALL - 2.2
                doors.append((before, middle, start, middle + 1.0))
            before, start = end, end + WALL
    return House(rooms, doors)


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


class Interior:
    """A furnished house: its walls, furniture and lamps.

    Attributes:
        house: its plan.
        mesh: all surfaces.
        obstacles: what stands on the floors, in plan.
        lights: position and strength of lamps and windows, ``(L, 4)``.
    """

    def __init__(self, seed: int) -> None:
        """The house of a world."""
        self.rng = rng = np.random.default_rng([seed, 51])
        self.house, self.soup = draw_house(seed), Soup(rng)
        self.obstacles: list[Rectangle] = []
        self._lights: list[tuple[float, float, float, float]] = []
        self.frame_look = self.soup.instance(Material.WOOD, colour(rng, *WOODS))
        self.skirting = colour(rng, (0.85, 0.84, 0.80), *WOODS)
        for room in self.house.rooms:
            self._enclose_and_fill(room)
        for door in self.house.doors:
            self._doorway(door)
        self.mesh, self.lights = self.soup.finish(FLAT), np.array(self._lights)

    def _enclose_and_fill(self, room: Room) -> None:
        """Everything inside the walls of a room."""
        rng, (x0, y0, x1, y1) = self.rng, room.area
        east, north = np.array([x1 - x0, 0.0, 0.0]), np.array([0.0, y1 - y0, 0.0])
        if room.kind in ("living", "bedroom", "office"):
            floor = self.soup.instance(
                Material.BOARDS, colour(rng, *WOODS), None, (rng.uniform(0.07, 0.16),)
            )
        else:
            side = float(rng.uniform(0.9, 1.3) if room.kind == "hall" else rng.uniform(0.2, 0.5))
            tone = colour(rng, (0.62, 0.60, 0.57), (0.50, 0.51, 0.53), (0.68, 0.58, 0.46))
            chequered = float(room.kind in ("bath", "kitchen") and rng.random() < 0.4)
            floor = self.soup.instance(Material.TILES, tone, 0.75 * tone, (side, 0.008, chequered))
        self._panel(np.array([x0, y0, 0.0]), east, north, floor)
        ceiling = self.soup.instance(Material.PLASTER, colour(rng, (0.88, 0.88, 0.86), spread=0.02))
        self._panel(np.array([x0, y0, room.height]), north, east, ceiling)
        tone = colour(rng, *_WALLS, spread=0.04)
        if room.kind == "bath":
            wall = self.soup.instance(
                Material.TILES, tone, 0.8 * tone, (float(rng.uniform(0.1, 0.25)), 0.006)
            )
        else:
            papered = float(rng.uniform(0.1, 0.3)) if rng.random() < 0.2 else 0.0
            wall = self.soup.instance(Material.PLASTER, tone, self.skirting, (0.08, papered, 0.08))
        for number in range(4):
            self._furnish(room, number, wall)
        self._fill_middle(room)
        self._lamps(room)

    def _doorway(self, door: Rectangle) -> None:
        """Jambs, lintel and threshold of an opening."""
        x0, y0, x1, y1 = door
        east, north, up = (
            np.array([x1 - x0, 0, 0]),
            np.array([0, y1 - y0, 0]),
            np.array([0, 0, DOOR_HEIGHT]),
        )
        corner = np.array([x0, y0, 0.0])
        if x1 - x0 > WALL + 0.01:
            jambs = (corner, north), (corner + east + north, -north)
        else:
            jambs = (corner + east, -east), (corner + north, east)
        lintel, threshold = (corner + up, north, east), (corner, east, north)
        for quad in (*((foot, along, up) for foot, along in jambs), lintel, threshold):
            self.soup.quad(*quad, self.frame_look)

    def _panel(self, corner: FloatArray, along: FloatArray, up: FloatArray, look: int) -> None:
        """A parallelogram with vertices at most ``_STEP`` apart, textured in metres from its corner."""
        width, height = float(np.linalg.norm(along)), float(np.linalg.norm(up))
        a, b = (
            np.linspace(0.0, 1.0, int(np.ceil(extent / _STEP)) + 1) for extent in (width, height)
        )
        points = corner + a[None, :, None] * along + b[:, None, None] * up
        u, v = np.meshgrid(a * width, b * height + corner[2] * (up[2] > 0.0))
        self.soup.patch(points, np.stack([u, v], axis=2), look)

    def _furnish(self, room: Room, number: int, wall: int) -> None:
        """One wall around its doors, seen from inside; furniture along it, pictures above that and windows."""
        rng, openings = self.rng, self.house.openings(room, number)
        (x, y), angle, length = room.side(number)
        ahead, up = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([0.0, 0.0, 1.0])
        for k, (start, end) in enumerate(pairwise([0.0, *np.ravel(openings), length])):
            low = DOOR_HEIGHT * (k % 2)
            self._panel(
                np.array([x, y, low]) + end * ahead,
                (start - end) * ahead,
                (room.height - low) * up,
                wall,
            )
        doors = [(a - 0.35, b + 0.35) for a, b in openings]
        windows = self._windows(room, number)
        density = {"corridor": 0.15, "hall": 0.7, "bath": 0.6}.get(room.kind, 0.8)
        pieces = STANDING[room.kind]
        left = 0.7
        while True:
            piece, width, depth = pieces[rng.integers(len(pieces))]
            width = min(width, length - 0.05 - left)
            if width < 0.6:
                return
            blocked = [end for start, end in doors if start < left + width and end > left]
            if blocked:
                left = max(blocked) + 0.02
                continue
            daylight = any(a < left + width and b > left for a, b in windows)
            frame = frame_at(x, y, angle)
            frame[3] += left * frame[0] + 0.01 * frame[1]
            stands = rng.random() < density and not (daylight and piece in TALL)
            if stands:
                self._place(piece, frame, width, depth)
            if not daylight and not (stands and piece in TALL) and rng.random() < 0.6:
                self._hang(frame, width)
            left += width + float(rng.uniform(0.05, 0.5))

    def _place(self, piece: Piece, frame: FloatArray, width: float, depth: float) -> None:
        piece(self.soup, self.rng, frame, width)
        corners = np.stack([frame[3], frame[3] + width * frame[0] + depth * frame[1]])
        self.obstacles.append((*corners.min(axis=0)[:2], *corners.max(axis=0)[:2]))

    def _hang(self, frame: FloatArray, width: float) -> None:
        """A picture, a poster, a mirror or a screen at the height of the eyes."""
        rng = self.rng
        across, high = float(rng.uniform(0.4, min(width, 1.2))), float(rng.uniform(0.4, 0.8))
        first, second = colour(rng, *PAINTS), colour(rng, *CLOTHS)
        kind = rng.random()
        if kind < 0.75:
            look = self.soup.instance(
                Material.PICTURE, first, second, (across, high, float(rng.integers(3)))
            )
        elif kind < 0.9:
            look = self.soup.instance(Material.SCREEN, first, second, (across, high))
        else:
            look = self.soup.instance(
                Material.PANE, np.array([0.72, 0.76, 0.78]), self.skirting, (across, high, 0.0)
            )
        low = (
            float(rng.uniform(0.0, width - across)),
            0.0,
            1.6 - 0.5 * high + float(rng.uniform(-0.1, 0.15)),
        )
        plate(self.soup, frame, low, (across, 0.02, high), look, self.frame_look)

    def _windows(self, room: Room, number: int) -> list[tuple[float, float]]:
        """Panes in an outside wall, which light the room; where they begin and end along it."""
        if number not in room.outside:
            return []
        rng = self.rng
        (x, y), angle, length = room.side(number)
        low, high = (1.6, 1.6) if room.kind == "hall" else (0.95, 1.2)
        width = min(float(rng.uniform(1.0, 1.7)), length - 0.4)
        spans, left = [], float(rng.uniform(0.2, 0.9))
        while left + width < length - 0.1:
            frame = frame_at(x, y, angle)
            sky = np.array([0.86, 0.92, 0.98]) * float(rng.uniform(0.9, 1.05))
            pane = self.soup.instance(Material.PANE, sky, self.skirting, (width, high, 1.0))
            plate(self.soup, frame, (left, 0.0, low), (width, 0.01, high), pane, self.frame_look)
            x_light, y_light, _ = frame[3] + (left + 0.5 * width) * frame[0] + 0.8 * frame[1]
            strength = (0.35 if room.kind == "hall" else 0.7) * width * high
            self._lights.append((x_light, y_light, low + 0.6 * high, strength))
            spans.append((left, left + width))
            left += width + float(rng.uniform(0.5, 2.5))
        return spans

    def _fill_middle(self, room: Room) -> None:
        """A table or a carpet; rows of racks in the hall."""
        rng, (x0, y0, x1, y1) = self.rng, room.area
        low = np.array([x0, y0]) + _DEEPEST + _AISLE
        free = np.array([x1, y1]) - _DEEPEST - _AISLE - low
        if room.kind == "hall":
            for y in np.arange(low[1], low[1] + free[1] - 0.5, 0.6 + 1.5):
                left = low[0]
                while left < x1 - _DEEPEST - _AISLE - 1.0:
                    piece, width, depth = STANDING["hall"][rng.integers(3)]
                    width = min(width, x1 - _DEEPEST - _AISLE - left)
                    self._place(piece, frame_at(left, float(y), 0.0), width, depth)
                    left += width + float(rng.choice([0.05, 1.3], p=[0.6, 0.4]))
            return
        if room.kind in ("living", "bedroom", "office") and free.min() > 0.2:
            size = np.minimum(free + 1.0, 2.6)
            tone, other = colour(rng, *CLOTHS), colour(rng, *PAINTS)
            carpet = self.soup.instance(
                Material.CARPET, tone, other, (size[0], size[1], float(rng.uniform(0.2, 0.5)))
            )
            corner = np.array([*(low + 0.5 * (free - size)), 0.01])
            self.soup.quad(corner, np.array([size[0], 0, 0]), np.array([0, size[1], 0]), carpet)
        if free[0] > 0.8 and free[1] > 1.2 and rng.random() < 0.8:
            width, depth = min(free[0], 1.8), min(free[1] - 0.6, 0.9)
            x, y = low + 0.5 * (free - np.array([width, depth]))
            dining(self.soup, rng, frame_at(float(x), float(y), 0.0), width, depth)
            self.obstacles.append(
                (float(x), float(y) - 0.3, float(x) + width, float(y) + depth + 0.3)
            )

    def _lamps(self, room: Room) -> None:
        """Flat lamps below the ceiling, about 3 m apart."""
        rng, (x0, y0, x1, y1) = self.rng, room.area
        bulb = self.soup.instance(Material.LAMP, np.array([1.0, 0.98, 0.92]))
        strength = (0.8 if room.kind == "hall" else 1.0) * float(rng.uniform(0.8, 1.2))
        across, along = (max(1, round((extent) / 3.4)) for extent in (x1 - x0, y1 - y0))
        for x in x0 + (np.arange(across) + 0.5) / across * (x1 - x0):
            for y in y0 + (np.arange(along) + 0.5) / along * (y1 - y0):
                frame = frame_at(x - 0.25, y - 0.15, 0.0, room.height - 0.06)
                solid(self.soup, frame, (0, 0, 0.001), (0.5, 0.3, 0.05), bulb)
                self._lights.append((float(x), float(y), room.height - 0.3, strength))
