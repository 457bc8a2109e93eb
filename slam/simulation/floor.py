"""The free floor of a house: where one can stand, and the ways between such places."""

import functools

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d, map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra

from slam.simulation.geometry import FloatArray, IntArray
from slam.simulation.interior import Interior

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

    def __init__(self, interior: Interior, seed: int) -> None:
        """Find what is free, and places in every room that can be reached."""
        house = interior.house
        areas = np.array([room.area for room in house.rooms])
        self._origin = areas[:, :2].min(axis=0) - 0.5
        shape = np.ceil((areas[:, 2:].max(axis=0) + 0.5 - self._origin) / CELL).astype(int)
        free = np.zeros((shape[1], shape[0]), dtype=np.uint8)
        for rectangles, value in (([*map(tuple, areas), *house.doors], 1), (interior.obstacles, 0)):
            for x0, y0, x1, y1 in rectangles:
                low, high = (
                    (np.array(corner) - self._origin) / CELL for corner in ((x0, y0), (x1, y1))
                )
                outwards = 0.0 if value else 1.0
                first = np.ceil(low - 0.5 - 0.5 * outwards).astype(int)
                last = np.floor(high + 0.5 + 0.5 * outwards).astype(int)
                free[first[1] : last[1], first[0] : last[0]] = value
        self._clearance = np.asarray(
            cv2.distanceTransform(free, cv2.DIST_L2, 5) * CELL, dtype=np.float64
        )
        self._cells = np.argwhere(self._clearance >= _CLEAR_M)[:, ::-1]  # (C, 2), column and row
        self._graph = self._connect()
        rng = np.random.default_rng([seed, 52])
        _, part = connected_components(self._graph, directed=False)
        centres = self._centres(self._cells)
        roomy = (part == np.bincount(part).argmax()) & (self.clearance(centres) >= _PLACE_CLEAR_M)
        chosen: list[int] = []
        rooms: list[int] = []
        for number, room in enumerate(house.rooms):  # up to five places a room
            inside = np.flatnonzero(roomy & room.contains(centres))
            found = rng.choice(inside, min(len(inside), 5), replace=False)
            chosen.extend(found)
            rooms.extend([number] * len(found))
        self.places = centres[chosen]
        self.room = np.array(rooms)
        self._at = np.array(chosen)

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

    @functools.lru_cache(maxsize=64)  # noqa: B019 - a floor lives as long as its world
    def _from(self, start: int) -> tuple[FloatArray, IntArray]:
        """Distance of all cells from a place, and the cell before each on the way."""
        length, before = dijkstra(
            self._graph, directed=False, indices=self._at[start], return_predecessors=True
        )
        return length, before
