"""A house: rooms on both sides of a corridor, a hall at its end, doors, and where one can walk between them."""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra

from slam.simulation.geometry import FloatArray, IntArray

Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1

WALL = 0.14  # thickness, metres
DOOR_HEIGHT = 2.1
KINDS = ("living", "kitchen", "office", "bedroom", "bath", "office")


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
            spans = ((left - x0, right - x0), (low - y0, high - y0), (x1 - right, x1 - left), (y1 - high, y1 - low))
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
    hall = Room("hall", (hall_x, hall_y, hall_x + wide, hall_y + deep), float(rng.uniform(3.8, 5.0)), (0, 1, 2))
    rooms, doors = [corridor, hall], [(length, 0.5 * width - 0.8, hall_x, 0.5 * width + 0.8)]
    kinds = list(rng.permutation(KINDS)) + list(rng.permutation(KINDS))
    for north in (False, True):
        start, before = 0.0, None
        while length - start > 3.2:
            end = start + float(rng.uniform(3.4, 6.0))
            end = length if length - end < 3.4 + WALL else end
            depth = float(rng.uniform(3.4, 5.5))
            low, high = (width + WALL, width + WALL + depth) if north else (-WALL - depth, -WALL)
            rooms.append(Room(str(kinds.pop()), (start, low, end, high), height, (2,) if north else (0,)))
            door = start + float(rng.uniform(0.75, end - start - 1.85))
            opening = float(rng.uniform(0.95, 1.1))
            doors.append((door, width, door + opening, low) if north else (door, -WALL, door + opening, 0.0))
            if before is not None and rng.random() < 0.5:
                middle = width + WALL + 1.2 if north else -WALL - 2.2
                doors.append((before, middle, start, middle + 1.0))
            before, start = end, end + WALL
    return House(rooms, doors)


CELL = 0.08  # metres
_CLEAR_M = 0.44  # of a path's cells from walls and furniture, which begin up to a cell nearer
_SMOOTH_CLEAR_M = 0.42  # of a path after its corners are rounded
_PLACE_CLEAR_M = 0.55
_CORNERS_M = (0.4, 0.25, 0.12)  # by how much corners are rounded, the first that keeps clear


class Floor:
    """The free floor of a house.

    Attributes:
        places: where to stop, ``(P, 2)``.
        room: the room of each place, ``(P,)``.
    """

    def __init__(self, house: House, obstacles: list[Rectangle], seed: int) -> None:
        """Find what is free, and places in every room that can be reached."""
        areas = np.array([room.area for room in house.rooms])
        self._origin = areas[:, :2].min(axis=0) - 0.5
        shape = np.ceil((areas[:, 2:].max(axis=0) + 0.5 - self._origin) / CELL).astype(int)
        free = np.zeros((shape[1], shape[0]), dtype=np.uint8)
        for rectangles, value in (([*map(tuple, areas), *house.doors], 1), (obstacles, 0)):
            for x0, y0, x1, y1 in rectangles:
                low, high = ((np.array(corner) - self._origin) / CELL for corner in ((x0, y0), (x1, y1)))
                outwards = 0.0 if value else 1.0
                first = np.ceil(low - 0.5 - 0.5 * outwards).astype(int)
                last = np.floor(high + 0.5 + 0.5 * outwards).astype(int)
                free[first[1] : last[1], first[0] : last[0]] = value
        self._clearance = np.asarray(cv2.distanceTransform(free, cv2.DIST_L2, 5) * CELL, dtype=np.float64)
        self._cells = np.argwhere(self._clearance >= _CLEAR_M)[:, ::-1]  # (C, 2), column and row
        self._graph = self._connect()
        self.places, self.room, self._at = self._choose(house.rooms, np.random.default_rng([seed, 52]))

    def clearance(self, points: FloatArray) -> FloatArray:
        """Distance in plan from points ``(M, 2)`` to what stands there, metres, ``(M,)``."""
        row_column = ((points - self._origin) / CELL - 0.5).T[::-1]
        return np.asarray(map_coordinates(self._clearance, row_column, order=1, mode="nearest"))

    def path(self, start: int, end: int) -> FloatArray:
        """A walk between two places, a point every ``CELL`` or so, ``(M, 2)``."""
        _, before = self._from(start)
        cells, at = [self._at[end]], int(self._at[end])
        while at != self._at[start]:
            at = int(before[at])
            cells.append(at)
        walk = self._centres(self._cells[cells[::-1]])
        for corner_m in _CORNERS_M:
            rounded = gaussian_filter1d(walk, corner_m / CELL, axis=0, mode="nearest")
            rounded[[0, -1]] = walk[[0, -1]]
            if self.clearance(rounded).min() >= _SMOOTH_CLEAR_M:
                return np.asarray(rounded)
        return walk

    def lengths(self, start: int) -> FloatArray:
        """How far every place is from one of them, ``(P,)``."""
        return np.asarray(self._from(start)[0][self._at])

    def _centres(self, cells: IntArray) -> FloatArray:
        return np.asarray(self._origin + (cells + 0.5) * CELL)

    def _connect(self) -> coo_array:
        """Neighbouring cells, farther apart the nearer they are to walls."""
        number = np.full(self._clearance.shape, -1)
        number[self._cells[:, 1], self._cells[:, 0]] = np.arange(len(self._cells))
        starts, ends, lengths = [], [], []
        for step in ((1, 0), (0, 1), (1, 1), (1, -1)):
            there = self._cells + step
            inside = (there >= 0).all(axis=1) & (there < number.T.shape).all(axis=1)
            other = np.where(inside, number[there[:, 1] * inside, there[:, 0] * inside], -1)
            here = np.flatnonzero(other >= 0)
            near = self._clearance[self._cells[here, 1], self._cells[here, 0]]
            starts.append(here)
            ends.append(other[here])
            lengths.append(CELL * np.hypot(*step) * (1.0 + 0.15 / near**2))
        joined = np.concatenate(lengths), (np.concatenate(starts), np.concatenate(ends))
        return coo_array(joined, shape=(len(self._cells),) * 2).tocsr()

    def _choose(self, house_rooms: list[Room], rng: np.random.Generator) -> tuple[FloatArray, IntArray, IntArray]:
        """Up to five places a room: where they are, their rooms and their cells."""
        _, part = connected_components(self._graph, directed=False)
        centres = self._centres(self._cells)
        roomy = (part == np.bincount(part).argmax()) & (self.clearance(centres) >= _PLACE_CLEAR_M)
        chosen: list[int] = []
        rooms: list[int] = []
        for number, room in enumerate(house_rooms):
            inside = np.flatnonzero(roomy & room.contains(centres))
            found = rng.choice(inside, min(len(inside), 5), replace=False)
            chosen.extend(found)
            rooms.extend([number] * len(found))
        return centres[chosen], np.array(rooms), np.array(chosen)

    @functools.lru_cache(maxsize=64)  # noqa: B019 - a floor lives as long as its world
    def _from(self, start: int) -> tuple[FloatArray, IntArray]:
        """Distance of all cells from a place, and the cell before each on the way."""
        length, before = dijkstra(self._graph, directed=False, indices=self._at[start], return_predecessors=True)
        return length, before
