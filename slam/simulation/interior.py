"""A furnished house.

Its plan: rooms on both sides of a corridor, a hall at its end, and the doors; its walls, floors and
ceilings, and the furniture and lamps in its rooms.
"""

import functools
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import FloatArray
from slam.simulation.furniture import STANDING, TALL, Piece, dining
from slam.simulation.geometry import FLAT, luck, unit
from slam.simulation.shapes import UP, Rectangle, Site, lattice

WALL = 0.14  # thickness, metres
KINDS = ("living", "kitchen", "office", "bedroom", "bath", "office")
DOOR_HEIGHT = 2.1
_AISLE = 1.0  # left free between the furniture at the walls and the table in the middle, metres
_DEEPEST = 0.65  # piece at a wall, metres
_TOUCHES = 1e-6  # metres
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
        low, high = self.area[:2], self.area[2:]
        return np.asarray(((points > low) & (points < high)).all(axis=1))


def draw_plan(seed: int) -> tuple[list[Room], list[Rectangle]]:
    """The rooms of a house, and its doorways as the rectangles of the walls that they cut."""
    rng = luck(seed, 50)
    length, width, height = rng.uniform((14.0, 1.9, 2.45), (20.0, 2.4, 2.9)).tolist()
    corridor = Room("corridor", (0.0, 0.0, length, width), height, (3,))
    wide, deep = rng.uniform(9.0, 13.0), rng.uniform(7.5, 10.0)
    hall_x, hall_y = length + WALL, 0.5 * width - deep * rng.uniform(0.35, 0.65)
    area = (hall_x, hall_y, hall_x + wide, hall_y + deep)
    hall = Room("hall", area, rng.uniform(3.8, 5.0), (0, 1, 2))
    rooms, doors = [corridor, hall], [(length, 0.5 * width - 0.8, hall_x, 0.5 * width + 0.8)]
    kinds = list(rng.permutation(KINDS)) + list(rng.permutation(KINDS))
    for north in (False, True):
        start, before = 0.0, None
        wall = width if north else -WALL  # of the corridor, its southern side
        while length - start > 3.2:
            end = start + rng.uniform(3.4, 6.0)
            end = length if length - end < 3.4 + WALL else end
            depth = rng.uniform(3.4, 5.5)
            low = wall + WALL if north else wall - depth
            kind, outside = str(kinds.pop()), (2,) if north else (0,)
            rooms.append(Room(kind, (start, low, end, low + depth), height, outside))
            door = start + rng.uniform(0.75, end - start - 1.85)
            doors.append((door, wall, door + rng.uniform(0.95, 1.1), wall + WALL))
            if before is not None and rng.random() < 0.5:
                middle = low + 1.2 if north else wall - 2.2
                doors.append((before, middle, start, middle + 1.0))
            before, start = end, end + WALL
    return rooms, doors


class Interior:
    """A furnished house: its walls, furniture and lamps.

    Attributes:
        rooms: between their walls.
        doors: doorways as the rectangles of the walls that they cut.
        mesh: all surfaces.
        obstacles: what stands on the floors, in plan.
        lights: position and strength of lamps and windows, ``(L, 4)``.
    """

    def __init__(self, seed: int) -> None:
        """The house of a world."""
        self.rng = rng = luck(seed, 51)
        self.site = Site(rng)
        self.rooms, self.doors = draw_plan(seed)
        self.obstacles: list[Rectangle] = []
        self._lights: list[tuple[float, float, float, float]] = []
        self.frame_look = self.site.instance("wood", "wood")
        self.skirting = self.site.colour("skirting")
        for room in self.rooms:
            self._enclose_and_fill(room)
        for door in self.doors:
            self._doorway(door)
        self.mesh, self.lights = self.site.finish(FLAT), np.array(self._lights)

    def _enclose_and_fill(self, room: Room) -> None:
        """Everything inside the walls of a room."""
        rng, site, (x0, y0, x1, y1) = self.rng, self.site, room.area
        east, north = np.array([x1 - x0, 0.0, 0.0]), np.array([0.0, y1 - y0, 0.0])
        if room.kind in ("living", "bedroom", "office"):
            tone = site.colour("wood")
            floor = site.instance("boards", tone, 1.0, (rng.uniform(0.07, 0.16),))
        else:
            side = rng.uniform(0.9, 1.3) if room.kind == "hall" else rng.uniform(0.2, 0.5)
            tone = site.colour("floor tiles")
            chequered = room.kind in ("bath", "kitchen") and rng.random() < 0.4
            floor = site.instance("tiles", tone, 0.75, (side, 0.008, chequered))
        self._panel(np.array([x0, y0, 0.0]), east, north, floor)
        ceiling = site.instance("plaster", "ceiling")
        self._panel(np.array([x0, y0, room.height]), north, east, ceiling)
        tone = site.colour("wall")
        if room.kind == "bath":
            wall = site.instance("tiles", tone, 0.8, (rng.uniform(0.1, 0.25), 0.006))
        else:
            papered = rng.uniform(0.1, 0.3) if rng.random() < 0.2 else 0.0
            wall = site.instance("plaster", tone, self.skirting, (0.08, papered, 0.08))
        for number in range(4):
            self._furnish(room, number, wall)
        self._fill_middle(room)
        self._lamps(room)

    def _doorway(self, door: Rectangle) -> None:
        """Jambs, lintel and threshold of an opening."""
        is_wide = door[2] - door[0] > WALL + _TOUCHES
        place, width = self.site.side(door, 0 if is_wide else 1)
        corner, up = place.origin, DOOR_HEIGHT * UP
        along, through = width * place.frame[0], WALL * place.frame[1]
        self.site.quad(corner, through, up, self.frame_look)
        self.site.quad(corner + along + through, -through, up, self.frame_look)
        self.site.quad(corner + up, through, along, self.frame_look)
        self.site.quad(corner, along, through, self.frame_look)

    def _panel(self, corner: FloatArray, along: FloatArray, up: FloatArray, look: int) -> None:
        """A parallelogram, vertices at most ``_STEP`` apart, textured in metres from its corner."""
        sides = np.stack([along, up])
        ticks = [
            np.linspace(0.0, extent, int(np.ceil(extent / _STEP)) + 1)
            for extent in np.linalg.norm(sides, axis=1)
        ]
        at = lattice(*ticks)
        uv = at + np.array([0.0, corner[2] * (up[2] > 0.0)])
        self.site.patch(corner + at @ unit(sides), uv, look)

    def _furnish(self, room: Room, number: int, wall: int) -> None:
        """One wall around its doors, seen from inside, with windows, furniture and pictures."""
        rng, (foot, length) = self.rng, self.site.side(room.area, number)
        openings = self._openings(foot, length)
        for k, (start, end) in enumerate(pairwise([0.0, *np.ravel(openings), length])):
            low = DOOR_HEIGHT * (k % 2)
            corner = foot.moved(end, up=low).origin
            self._panel(corner, (start - end) * foot.frame[0], (room.height - low) * UP, wall)
        doors = [(a - 0.35, b + 0.35) for a, b in openings]
        windows = self._windows(room, number)
        density = {"corridor": 0.15, "hall": 0.7, "bath": 0.6}.get(room.kind, 0.8)
        pieces = STANDING[room.kind]
        left = 0.7
        while True:
            piece, width = pieces[rng.integers(len(pieces))]
            width = min(width, length - 0.05 - left)
            if width < 0.6:
                return
            blocked = [end for start, end in doors if start < left + width and end > left]
            if blocked:
                left = max(blocked) + 0.02
                continue
            daylight = any(a < left + width and b > left for a, b in windows)
            place = foot.moved(left, 0.01)
            stands = rng.random() < density and not (daylight and piece in TALL)
            if stands:
                self._place(piece, place, width)
            if not daylight and not (stands and piece in TALL) and rng.random() < 0.6:
                self._hang(place, width)
            left += width + rng.uniform(0.05, 0.5)

    def _openings(self, wall: Site, length: float) -> list[tuple[float, float]]:
        """Where the doors in a wall begin and end along it, in order."""
        found = []
        for door in self.doors:
            corners = (np.reshape(door, (2, 2)) - wall.origin[:2]) @ wall.frame[:2, :2].T
            (start, end), (_, inwards) = np.sort(corners, axis=0).T
            if abs(inwards) < _TOUCHES and start > 0.0 and end < length:
                found.append((start, end))
        return sorted(found)

    def _place(self, piece: Piece, place: Site, width: float) -> None:
        depth = piece(place, width)
        corners = np.sort([place.origin, place.moved(width, depth).origin], axis=0)
        self.obstacles.append((*corners[0, :2], *corners[1, :2]))

    def _hang(self, place: Site, width: float) -> None:
        """A picture or a mirror at the height of the eyes."""
        rng = self.rng
        size = rng.uniform(0.4, min(width, 1.2)), rng.uniform(0.4, 0.8)
        if rng.random() < 0.8:
            look = place.instance("picture", "paint", "cloth", size)
        else:
            look = place.instance("pane", (0.72, 0.76, 0.78), self.skirting, size)
        low = (rng.uniform(0.0, width - size[0]), 0.0, rng.uniform(1.5, 1.75) - 0.5 * size[1])
        place.plate(low, (size[0], 0.02, size[1]), look, self.frame_look)

    def _windows(self, room: Room, number: int) -> list[tuple[float, float]]:
        """Panes in an outside wall, which light the room; where they begin and end along it."""
        if number not in room.outside:
            return []
        rng = self.rng
        place, length = self.site.side(room.area, number)
        low, high = (1.6, 1.6) if room.kind == "hall" else (0.95, 1.2)
        width = min(rng.uniform(1.0, 1.7), length - 0.4)
        spans, left = [], rng.uniform(0.2, 0.9)
        while left + width < length - 0.1:
            sky = np.array([0.86, 0.92, 0.98]) * rng.uniform(0.9, 1.05)
            pane = place.instance("pane", sky, self.skirting, (width, high, 1.0))
            place.plate((left, 0.0, low), (width, 0.01, high), pane, self.frame_look)
            light = place.moved(left + 0.5 * width, 0.8, low + 0.6 * high).origin
            strength = (0.35 if room.kind == "hall" else 0.7) * width * high
            self._lights.append((*light, strength))
            spans.append((left, left + width))
            left += width + rng.uniform(0.5, 2.5)
        return spans

    def _fill_middle(self, room: Room) -> None:
        """A table or a carpet; rows of racks in the hall."""
        rng, (x0, y0, x1, y1) = self.rng, room.area
        low = np.array([x0, y0]) + _DEEPEST + _AISLE
        high = np.array([x1, y1]) - _DEEPEST - _AISLE
        free = high - low
        if room.kind == "hall":
            for y in np.arange(low[1], low[1] + free[1] - 0.5, 0.6 + 1.5):
                left = low[0]
                while left < high[0] - 1.0:
                    piece, width = STANDING["hall"][rng.integers(3)]
                    width = min(width, high[0] - left)
                    self._place(piece, self.site.moved(left, y), width)
                    left += width + rng.choice([0.05, 1.3], p=[0.6, 0.4])
            return
        if room.kind in ("living", "bedroom", "office") and free.min() > 0.2:
            size = np.minimum(free + 1.0, 2.6)
            tones = self.site.colour("cloth"), self.site.colour("paint")
            motif = rng.uniform(0.2, 0.5)
            carpet = self.site.instance("carpet", *tones, (*size, motif))
            corner = np.array([*(low + 0.5 * (free - size)), 0.01])
            self.site.quad(corner, np.array([size[0], 0, 0]), np.array([0, size[1], 0]), carpet)
        if free[0] > 0.8 and free[1] > 1.2 and rng.random() < 0.8:
            width, depth = min(free[0], 1.8), min(free[1] - 0.6, 0.9)
            x, y = low + 0.5 * (free - np.array([width, depth]))
            dining(self.site.moved(x, y), width, depth)
            self.obstacles.append((x, y - 0.3, x + width, y + depth + 0.3))

    def _lamps(self, room: Room) -> None:
        """Flat lamps below the ceiling, about 3 m apart."""
        rng, (x0, y0, x1, y1) = self.rng, room.area
        bulb = self.site.instance("lamp", (1.0, 0.98, 0.92))
        strength = (0.8 if room.kind == "hall" else 1.0) * rng.uniform(0.8, 1.2)
        for x in _middles(x0, x1):
            for y in _middles(y0, y1):
                lamp = self.site.moved(x - 0.25, y - 0.15, room.height - 0.06)
                lamp.box((0.5, 0.3, 0.05), bulb, (0, 0, 0.001))
                self._lights.append((x, y, room.height - 0.3, strength))


def _middles(low: float, high: float) -> list[float]:
    """Of the equal parts of a stretch, of about 3.4 m."""
    count = max(1, round((high - low) / 3.4))
    return (low + (np.arange(count) + 0.5) / count * (high - low)).tolist()


# which several motions and hazards share
interior_of = functools.lru_cache(maxsize=4)(Interior)
