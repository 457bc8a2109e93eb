"""The plan of a house: rooms on both sides of a corridor, a hall at its end, and the doors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.simulation.geometry import FloatArray
from slam.simulation.rectangle import Rectangle

WALL = 0.14  # thickness, metres
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
