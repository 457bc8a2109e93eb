"""The motion of a camera that is carried over the free floor of a house.

On the floor are places where one can stand, and ways between them. A motion has legs between
places, turns, sweeps and rests; the unrest of its carrier is on top of all of them.
"""

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d, map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial.transform import Rotation

from slam.geometry import se3
from slam.geometry.se3 import FloatArray, IntArray
from slam.simulation.geometry import luck
from slam.simulation.interior import Interior

CELL = 0.08  # of the floor, metres
_CLEAR_M = 0.44  # of a path's cells from walls and furniture, which begin up to a cell nearer
_SMOOTH_CLEAR_M = 0.42  # of a path after its corners are rounded
_PLACE_CLEAR_M = 0.55
_CORNERS_M = (0.4, 0.25, 0.12)  # by how much corners are rounded, the first that keeps clear
CLOCK = 120.0  # samples of a motion a second
FASTEST_TURN_DEG = 17.0  # a frame
_STRIDE_M = 0.72
_SETTLED_S = 0.15  # over which turns and starts are smoothed
_CARRIER_CLEAR_M = 0.4  # of the carrier in the plan, where nothing is swayed any further

# its carrier looks along x, with y to the left and z up
R_CARRIER_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class Floor:
    """The free floor of a house.

    Attributes:
        places: where to stop, ``(P, 2)``.
        room: the room of each place, ``(P,)``.
    """

    def __init__(self, interior: Interior, seed: int) -> None:
        """Find what is free, and places in every room that can be reached."""
        areas = np.array([room.area for room in interior.rooms])
        self._origin = areas[:, :2].min(axis=0) - 0.5
        columns, rows = np.ceil((areas[:, 2:].max(axis=0) + 0.5 - self._origin) / CELL).astype(int)
        free = np.zeros((rows, columns), dtype=np.uint8)
        for rectangles, value in (([*areas, *interior.doors], 1), (interior.obstacles, 0)):
            for rectangle in rectangles:
                corners = (np.reshape(rectangle, (2, 2)) - self._origin) / CELL
                (left, low), (right, high) = np.rint(corners).astype(int)
                free[low:high, left:right] = value
        self._clearance = np.asarray(
            cv2.distanceTransform(free, cv2.DIST_L2, 5) * CELL, dtype=np.float64
        )
        # of each cell of the floor, (C, 2)
        self._centres = self._origin + CELL * (0.5 + np.argwhere(free >= 0)[:, ::-1])
        self._graph = self._connect()
        rng = luck(seed, 52)
        _, part = connected_components(self._graph, directed=False)
        roomy = self._clearance.ravel() >= _PLACE_CLEAR_M
        roomy &= part == np.bincount(part).argmax()
        chosen = []
        for room in interior.rooms:  # up to five places a room
            inside = np.flatnonzero(roomy & room.contains(self._centres))
            chosen.append(rng.choice(inside, min(len(inside), 5), replace=False))
        self._at = np.concatenate(chosen)
        self.places = self._centres[self._at]
        self.room = np.repeat(np.arange(len(chosen)), list(map(len, chosen)))

    def clearance(self, points: FloatArray) -> FloatArray:
        """Distance in plan from points ``(M, 2)`` to what stands there, metres, ``(M,)``."""
        row_column = ((points - self._origin) / CELL - 0.5).T[::-1]
        return map_coordinates(self._clearance, row_column, order=1, mode="nearest")

    def path(self, start: int, end: int) -> FloatArray:
        """A walk between two places, a point every ``CELL`` or so, ``(M, 2)``."""
        _, before = self._from(start)
        cells = [self._at[end]]
        while cells[-1] != self._at[start]:
            cells.append(before[cells[-1]])
        walk = self._centres[cells[::-1]]
        for corner_m in _CORNERS_M:
            rounded = gaussian_filter1d(walk, corner_m / CELL, axis=0, mode="nearest")
            rounded[[0, -1]] = walk[[0, -1]]
            if self.clearance(rounded).min() >= _SMOOTH_CLEAR_M:
                return rounded
        return walk

    def lengths(self, start: int) -> FloatArray:
        """How far every place is from one of them, ``(P,)``."""
        return self._from(start)[0][self._at]

    def _connect(self) -> coo_array:
        """Neighbouring cells, farther apart the nearer they are to walls."""
        number = np.arange(self._clearance.size).reshape(self._clearance.shape)
        is_clear = self._clearance >= _CLEAR_M
        length = CELL * (1.0 + 0.15 / np.maximum(self._clearance, CELL) ** 2)
        edges = []
        for step in ((0, 1), (1, 0), (1, 1), (1, -1)):
            # nothing is clear at the edge, where rows and columns go round
            joined = is_clear & np.roll(is_clear, step, axis=(0, 1))
            other = np.roll(number, step, axis=(0, 1))
            edges.append((np.hypot(*step) * length[joined], number[joined], other[joined]))
        lengths, starts, ends = map(np.concatenate, zip(*edges))
        return coo_array((lengths, (starts, ends)), shape=(number.size,) * 2).tocsr()

    @functools.lru_cache(maxsize=64)  # noqa: B019 - a floor lives as long as its world
    def _from(self, start: int) -> tuple[FloatArray, IntArray]:
        """Distance of all cells from a place, and the cell before each on the way."""
        length, before = dijkstra(
            self._graph, directed=False, indices=self._at[start], return_predecessors=True
        )
        return length, before


@dataclass(frozen=True)
class Gait:
    """How one kind of carrier moves."""

    height_m: tuple[float, float]  # of the camera, lowest and highest
    climb_m: float  # by how much the height wanders on the way
    speed: float  # metres a second
    turn_deg: float  # a second, at most, on the spot
    rests: tuple[float, float, float]  # how often it turns, sweeps and stands still at a place
    bob_m: float  # up and down with every step
    sway_m: float  # to the sides with every second step, and by unrest
    wander_deg: float  # how far it looks to the sides, and by a third of it up and down, on its way
    tremor_deg: float  # of the hand or the motors
    roll_deg: float  # how far it tilts to the sides
    pitch_deg: float  # of the camera, upwards


# of each `slam.simulation.options.Motion`
GAITS: dict[str, Gait] = {
    "walk": Gait((1.45, 1.7), 0.02, 1.1, 80.0, (0.5, 0.2, 0.3), 0.025, 0.03, 10.0, 0.25, 1.0, -3.0),
    "look": Gait((1.45, 1.7), 0.05, 0.8, 70.0, (1.6, 1.0, 0.4), 0.02, 0.03, 14.0, 0.3, 1.2, -2.0),
    "phone": Gait(
        (1.2, 1.5), 0.08, 0.8, 110.0, (0.8, 0.8, 0.4), 0.015, 0.04, 22.0, 0.5, 2.0, -10.0
    ),
    "drone": Gait((1.0, 1.25), 0.2, 0.9, 70.0, (0.6, 0.5, 0.3), 0.0, 0.05, 30.0, 0.15, 0.6, -5.0),
    "robot": Gait((0.32, 0.45), 0.0, 0.5, 60.0, (0.8, 0.0, 0.3), 0.0, 0.0, 0.0, 0.04, 0.16, 4.0),
    "turn": Gait((1.2, 1.5), 0.03, 0.0, 90.0, (0.7, 3.0, 0.0), 0.0, 0.03, 30.0, 0.3, 15.0, -5.0),
}


class Carried:
    """A motion, ``CLOCK`` samples a second.

    Its channels ``(M, 6)`` are x, y, z in metres, yaw to the left from east, pitch downwards and
    roll in radians.
    """

    def __init__(self, floor: Floor, motion: str, seconds: float, rate: float, seed: int) -> None:
        """Draw a motion.

        Args:
            floor: where the carrier may go.
            motion: one of `GAITS`.
            seconds: how long it lasts at least.
            rate: frames a second of the camera, which limits how fast it turns.
            seed: of the world.
        """
        rng, gait = luck(seed, 53, *motion.encode()), GAITS[motion]
        turn = np.deg2rad(min(gait.turn_deg, 0.9 * FASTEST_TURN_DEG * rate))
        base = _Walk(floor, gait, turn, rng).over(int(np.ceil(seconds * CLOCK)) + 2)
        base = gaussian_filter1d(base, _SETTLED_S * CLOCK, axis=0, mode="nearest")
        count = len(base)
        x, y, yaw, pitch, moved = base.T
        step = np.cumsum(moved * gait.speed / CLOCK) / _STRIDE_M * 2.0 * np.pi
        free = np.clip(floor.clearance(base[:, :2]) - _CARRIER_CLEAR_M, 0.0, 1.0)
        sways, climbs, turns, nods, rolls = _unrest(rng, (5, count), 0.9)
        tremors = _unrest(rng, (3, count), 0.05) + 0.7 * _unrest(rng, (3, count), 0.25)
        side = np.clip(gait.sway_m * (moved * np.sin(0.5 * step) + sways), -free, free)
        height = rng.uniform(*gait.height_m) + gait.climb_m * climbs
        z = height + moved * gait.bob_m * np.cos(step)
        wander = np.deg2rad(gait.wander_deg) * (0.3 + 0.7 * moved)
        yaw = yaw + wander * turns
        pitch = pitch + np.deg2rad(gait.pitch_deg) + wander / 3.0 * nods
        swing = 0.3 * moved * gait.sway_m * np.cos(0.5 * step)
        roll = np.deg2rad(gait.roll_deg) * rolls + swing
        angles = np.stack([yaw, -pitch, roll]) + np.deg2rad(gait.tremor_deg) * tremors
        self._channels = np.vstack([x + side * np.sin(yaw), y - side * np.cos(yaw), z, angles]).T

    def at(self, seconds: FloatArray) -> FloatArray:
        """The channels at times ``(N,)``, ``(N, 6)``; its ends are held."""
        clock = np.arange(len(self._channels)) / CLOCK
        return se3.interpolated(seconds, clock, self._channels)

    def poses(self, seconds: FloatArray) -> FloatArray:
        """``T_scene_camera`` at times ``(N,)``, ``(N, 4, 4)``."""
        channels = self.at(seconds)
        R_scene_carrier = Rotation.from_euler("ZYX", channels[:, 3:]).as_matrix()
        return se3.make(R_scene_carrier @ R_CARRIER_CAMERA, channels[:, :3])


def _unrest(rng: np.random.Generator, shape: tuple[int, int], seconds: float) -> FloatArray:
    """Noise of unit deviation within two and a half, smooth over a time along the last axis."""
    sigma = seconds * CLOCK
    noise = gaussian_filter1d(rng.standard_normal(shape), sigma, mode="wrap")
    return np.clip(noise * np.sqrt(3.54 * sigma), -2.5, 2.5)


class _Walk:
    """Strings legs and rests together: x, y, yaw and pitch at every tick, and whether one walks."""

    def __init__(self, floor: Floor, gait: Gait, turn: float, rng: np.random.Generator) -> None:
        self._floor = floor
        self._gait = gait
        self._turn = turn
        self._rng = rng
        self._visits = np.zeros(int(floor.room.max()) + 1)
        self._place = int(rng.integers(len(floor.places)))
        self._yaw = rng.uniform(-np.pi, np.pi)
        self._parts: list[FloatArray] = []

    def over(self, ticks: int) -> FloatArray:
        """So many ticks, ``(ticks, 5)``."""
        while sum(map(len, self._parts)) < ticks:
            if self._gait.speed:
                self._leg()
            for act, share in zip((self._look_round, self._sweep, self._stand), self._gait.rests):
                for _ in range(int(share + self._rng.random())):
                    act()
        return np.concatenate(self._parts)[:ticks]

    def _leg(self) -> None:
        """Walk to another place, rather a near one in a room that was seldom visited."""
        floor, rng = self._floor, self._rng
        self._visits[floor.room[self._place]] += 1
        longing = (
            floor.lengths(self._place)
            + 8.0 * self._visits[floor.room]
            + rng.uniform(0.0, 8.0, len(floor.places))
        )
        longing[self._place] = np.inf
        goal = int(np.argmin(longing))
        path = floor.path(self._place, goal)
        length = se3.distance_along(path)
        along = np.linspace(0.0, length[-1], max(int(length[-1] / 0.02), 8))
        path = se3.interpolated(along, length, path)
        ahead = np.gradient(gaussian_filter1d(path, 12.0, axis=0, mode="nearest"), axis=0)
        heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
        self._turn_by((heading[0] - self._yaw + np.pi) % (2.0 * np.pi) - np.pi)
        heading += self._yaw - heading[0]
        pace = np.minimum(np.minimum(along, along[-1] - along) + 0.15, 0.5) / 0.5
        walking = np.diff(along) / (pace[1:] * self._gait.speed)
        turning = np.abs(np.diff(heading)) / (0.8 * self._turn)
        arrival = np.concatenate([[0.0], np.cumsum(np.maximum(walking, turning))])
        ticks = np.arange(1, int(arrival[-1] * CLOCK) + 1) / CLOCK
        channels = np.column_stack([path, heading, np.zeros_like(pace), pace])
        self._parts.append(se3.interpolated(ticks, arrival, channels))
        self._yaw, self._place = float(heading[-1]), goal

    def _look_round(self) -> None:
        """Turn on the spot."""
        self._turn_by(self._rng.choice([-1.0, 1.0]) * np.deg2rad(self._rng.uniform(60.0, 360.0)))

    def _sweep(self) -> None:
        """Look left and right, up and down."""
        wide, high = np.deg2rad(self._rng.uniform((20.0, 8.0), (45.0, 25.0)))
        seconds = max(self._rng.uniform(3.0, 5.0), 2.0 * np.pi * wide / self._turn)
        phase = np.linspace(0.0, 2.0 * np.pi, int(seconds * CLOCK))
        self._stay(self._yaw + wide * np.sin(phase), high * np.sin(2.0 * phase))

    def _stand(self) -> None:
        still = np.zeros(int(self._rng.uniform(0.7, 2.0) * CLOCK))
        self._stay(still + self._yaw, still)

    def _turn_by(self, angle: float) -> None:
        s = np.linspace(0.0, 1.0, int(1.5 * abs(angle) / self._turn * CLOCK) + 2)
        self._stay(self._yaw + angle * s * s * (3.0 - 2.0 * s), np.zeros_like(s))
        self._yaw += angle

    def _stay(self, yaw: FloatArray, pitch: FloatArray) -> None:
        place = np.tile(self._floor.places[self._place], (len(yaw), 1))
        self._parts.append(np.column_stack([place, yaw, pitch, np.zeros_like(yaw)]))
