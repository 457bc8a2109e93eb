"""A furnished house as a world: several rooms, a corridor and a hall, and a camera that is carried through them.

It goes where one can walk, in legs between places, turns, sweeps and rests, with its carrier's unrest.
"""

import functools
from dataclasses import dataclass
from typing import get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra

from slam.geometry import se3
from slam.runtime.errors import SequenceError
from slam.runtime.imports import import_open3d
from slam.simulation.geometry import Float32Array, FloatArray, IntArray, Material, Mesh, Moving
from slam.simulation.house import Interior
from slam.simulation.objects import person
from slam.simulation.options import Motion, SimulationOptions
from slam.simulation.texture import GLOWING
from slam.simulation.world import (
    SHUTTER,
    Hits,
    SimulatedWorld,
    Surface,
    place_rays,
    square_camera,
    through_lens,
)

CELL = 0.08  # metres
_CLEAR_M = 0.44  # of a path's cells from walls and furniture, which begin up to a cell nearer
_SMOOTH_CLEAR_M = 0.42  # of a path after its corners are rounded
_PLACE_CLEAR_M = 0.55
_CORNERS_M = (0.4, 0.25, 0.12)  # by how much corners are rounded, the first that keeps clear
CLOCK = 120.0  # samples of a motion a second
FASTEST_TURN_DEG = 17.0  # a frame
_STRIDE_M = 0.72
_SETTLED_S = 0.15  # over which turns and starts are smoothed
_CARRIER_CLEAR_M = 0.4  # of the carrier in the plan, where nothing is swayed any further
STILL_S = 3.0
_USUAL_FOV_DEG, _VARIED_FOV_DEG = 65.0, (55.0, 100.0)
_PEOPLE, _AHEAD_S, _NEAREST_M = 6, 3.5, 0.7  # the first of them walks ahead of the camera
_GREY = 0.4  # brightness that exposure aims at
_LONGEST_S, _METER_S, _METERED = (
    0.02,
    0.1,
    12,
)  # exposure in the light; the meter's period, and how often it is read
_RAYS = 48  # around a corner
_BOUNCES = 3
_ALBEDO = 0.55
_REACH_M = 9.0  # of a lamp


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
        rng, (_, part) = (
            np.random.default_rng([seed, 52]),
            connected_components(self._graph, directed=False),
        )
        centres = self._centres(self._cells)
        roomy = (part == np.bincount(part).argmax()) & (self.clearance(centres) >= _PLACE_CLEAR_M)
        chosen: list[int] = []
        rooms: list[int] = []
        for number, room in enumerate(house.rooms):  # up to five places a room
            inside = np.flatnonzero(roomy & room.contains(centres))
            found = rng.choice(inside, min(len(inside), 5), replace=False)
            chosen.extend(found)
            rooms.extend([number] * len(found))
        self.places, self.room, self._at = centres[chosen], np.array(rooms), np.array(chosen)

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
    pitch_deg: float  # of the camera, upwards


GAITS: dict[str, Gait] = {
    "walk": Gait((1.45, 1.7), 0.02, 1.1, 80.0, (0.5, 0.2, 0.3), 0.025, 0.03, 10.0, 0.25, -3.0),
    "look": Gait((1.45, 1.7), 0.05, 0.8, 70.0, (1.6, 1.0, 0.4), 0.02, 0.03, 14.0, 0.3, -2.0),
    "phone": Gait((1.2, 1.5), 0.08, 0.8, 110.0, (0.8, 0.8, 0.4), 0.015, 0.04, 22.0, 0.5, -10.0),
    "drone": Gait((1.0, 1.25), 0.2, 0.9, 70.0, (0.6, 0.5, 0.3), 0.0, 0.05, 30.0, 0.15, -5.0),
    "robot": Gait((0.32, 0.45), 0.0, 0.5, 60.0, (0.8, 0.0, 0.3), 0.0, 0.0, 0.0, 0.04, 4.0),
}
assert tuple(GAITS) == get_args(Motion)


class Carried:
    """A motion, ``CLOCK`` samples a second.

    Its channels ``(M, 6)`` are x, y, z in metres, yaw to the left from east, pitch upwards and roll in radians.
    """

    def __init__(self, floor: Floor, motion: str, seconds: float, rate: float, seed: int) -> None:
        """A motion of so many seconds for a camera of ``rate`` frames a second."""
        rng, gait = np.random.default_rng([seed, 53, *motion.encode()]), GAITS[motion]
        turn = np.deg2rad(min(gait.turn_deg, 0.9 * FASTEST_TURN_DEG * rate))
        base, moved = _Walk(floor, gait, turn, rng).over(int(np.ceil(seconds * CLOCK)) + 2)
        base = gaussian_filter1d(base, _SETTLED_S * CLOCK, axis=0, mode="nearest")
        moved = gaussian_filter1d(moved, _SETTLED_S * CLOCK, mode="nearest")
        count = len(base)
        x, y, yaw, pitch = base.T
        step = np.cumsum(moved * gait.speed / CLOCK) / _STRIDE_M * 2.0 * np.pi
        free = np.clip(floor.clearance(base[:, :2]) - _CARRIER_CLEAR_M, 0.0, 1.0)
        side = moved * gait.sway_m * np.sin(0.5 * step) + gait.sway_m * _unrest(rng, count, 0.6)
        side = np.clip(side, -free, free)
        unsteady = np.deg2rad(gait.tremor_deg)
        wander = np.deg2rad(gait.wander_deg) * (0.3 + 0.7 * moved)
        tremors = [
            unsteady * (_unrest(rng, count, 0.05) + 0.7 * _unrest(rng, count, 0.25))
            for _ in range(3)
        ]
        height = rng.uniform(*gait.height_m) + gait.climb_m * _unrest(rng, count, 1.5)
        z = height + moved * gait.bob_m * np.cos(step)
        yaw = yaw + wander * _unrest(rng, count, 0.9) + tremors[0]
        pitch = (
            pitch
            + np.deg2rad(gait.pitch_deg)
            + wander / 3.0 * _unrest(rng, count, 0.9)
            + tremors[1]
        )
        roll = (
            4.0 * unsteady * _unrest(rng, count, 0.8)
            + 0.3 * moved * gait.sway_m * np.cos(0.5 * step)
            + tremors[2]
        )
        self._channels = np.stack(
            [x + side * np.sin(yaw), y - side * np.cos(yaw), z, yaw, pitch, roll], axis=1
        )

    def at(self, seconds: FloatArray) -> FloatArray:
        """The channels at times ``(N,)``, ``(6, N)``."""
        clock = np.arange(len(self._channels)) / CLOCK
        return np.stack([np.interp(seconds, clock, channel) for channel in self._channels.T])

    def poses(self, seconds: FloatArray) -> FloatArray:
        """``T_scene_camera`` at times ``(N,)``, ``(N, 4, 4)``."""
        x, y, z, yaw, pitch, roll = self.at(seconds)
        level, zero = np.cos(pitch), np.zeros_like(x)
        forward = np.stack([np.cos(yaw) * level, np.sin(yaw) * level, np.sin(pitch)], axis=1)
        right = np.stack([np.sin(yaw), -np.cos(yaw), zero], axis=1)
        upright = se3.make(
            np.stack([right, np.cross(forward, right), forward], axis=2),
            np.stack([x, y, z], axis=1),
        )
        return upright @ se3.from_rotation_vector(
            np.stack([zero, zero, roll], axis=1), np.zeros((len(x), 3))
        )


def _unrest(rng: np.random.Generator, count: int, seconds: float) -> FloatArray:
    """Noise of unit deviation within two and a half that is smooth over a time, ``(count,)``."""
    sigma = seconds * CLOCK
    margin = int(4.0 * sigma)
    noise = gaussian_filter1d(rng.standard_normal(count + 2 * margin), sigma)[
        margin : margin + count
    ]
    return np.asarray(np.clip(noise * np.sqrt(3.54 * sigma), -2.5, 2.5))


class _Walk:
    """Strings legs and rests together: x, y, yaw and pitch at every tick, and whether one walks."""

    def __init__(self, floor: Floor, gait: Gait, turn: float, rng: np.random.Generator) -> None:
        self._floor, self._gait, self._turn, self._rng = floor, gait, turn, rng
        self._visits = np.zeros(int(floor.room.max()) + 1)
        self._place = int(rng.integers(len(floor.places)))
        self._yaw = float(rng.uniform(-np.pi, np.pi))
        self._parts: list[FloatArray] = []
        self._moved: list[FloatArray] = []

    def over(self, ticks: int) -> tuple[FloatArray, FloatArray]:
        """So many ticks: ``(ticks, 4)`` and ``(ticks,)``."""
        while sum(map(len, self._moved)) < ticks:
            self._leg()
            for act, share in zip((self._look_round, self._sweep, self._stand), self._gait.rests):
                for _ in range(int(share + self._rng.random())):
                    act()
        return np.concatenate(self._parts)[:ticks], np.concatenate(self._moved)[:ticks]

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
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        along = np.linspace(0.0, length[-1], max(int(length[-1] / 0.02), 8))
        path = np.stack([np.interp(along, length, axis) for axis in path.T], axis=1)
        ahead = np.minimum(np.arange(len(path)) + 25, len(path) - 1)
        ahead[-25:] = len(path) - 1
        behind = (
            np.minimum(np.arange(len(path)), len(path) - 26)
            if len(path) > 26
            else np.zeros(len(path), dtype=int)
        )
        towards = path[ahead] - path[behind]
        heading = np.unwrap(np.arctan2(towards[:, 1], towards[:, 0]))
        self._turn_by(float((heading[0] - self._yaw + np.pi) % (2.0 * np.pi) - np.pi))
        heading += self._yaw - heading[0]
        pace = np.minimum(np.minimum(along, along[-1] - along) + 0.15, 0.5) / 0.5 * self._gait.speed
        walking, turning = np.diff(along) / pace[1:], np.abs(np.diff(heading)) / (0.8 * self._turn)
        arrival = np.concatenate([[0.0], np.cumsum(np.maximum(walking, turning))])
        ticks = np.arange(1, int(arrival[-1] * CLOCK) + 1) / CLOCK
        at = np.interp(ticks, arrival, np.arange(len(path)))
        rows = np.arange(len(path))
        track = [np.interp(at, rows, channel) for channel in (path[:, 0], path[:, 1], heading)]
        self._add(
            np.stack([*track, np.zeros_like(at)], axis=1),
            np.interp(at, rows, pace) / self._gait.speed,
        )
        self._yaw, self._place = float(heading[-1]), goal

    def _look_round(self) -> None:
        """Turn on the spot."""
        self._turn_by(
            float(self._rng.choice([-1.0, 1.0]) * np.deg2rad(self._rng.uniform(60.0, 360.0)))
        )

    def _sweep(self) -> None:
        """Look left and right, up and down."""
        wide, high = np.deg2rad(self._rng.uniform((20.0, 8.0), (45.0, 25.0)))
        seconds = max(float(self._rng.uniform(3.0, 5.0)), 2.0 * np.pi * wide / self._turn)
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
        x, y = self._parts[-1][-1, :2] if self._parts else self._floor.places[self._place]
        self._add(
            np.stack([np.full_like(yaw, x), np.full_like(yaw, y), yaw, pitch], axis=1),
            np.zeros_like(yaw),
        )

    def _add(self, part: FloatArray, moved: FloatArray) -> None:
        self._parts.append(part)
        self._moved.append(moved)


class SimulatedRooms(SimulatedWorld):
    """A house and a walk through it; the attributes are those of `SimulatedWorld`."""

    def __init__(self, options: SimulationOptions) -> None:
        """Plan the house and the walk; ``SequenceError`` where there are too few frames."""
        if options.frames < 2:
            raise SequenceError(f"a walk needs at least 2 frames; got {options.frames}")
        self._interior = _interior(options.seed)
        floor = Floor(self._interior, options.seed)
        seconds = options.frames / options.rate + _AHEAD_S + 1.0
        motions = _PEOPLE if "people" in options.hazards else 1
        self._carried = Carried(
            floor, options.motion or "walk", seconds, options.rate, options.seed
        )
        self._walks = [
            Carried(floor, "walk", seconds, options.rate, options.seed + 1000 * k)
            for k in range(1, motions)
        ]
        rng = np.random.default_rng([options.seed, 57])
        crowd = [
            lambda soup: person(soup, rng, 0.0, 0.0)
        ] * _PEOPLE  # around their own origins, looking along x
        self._people = Moving(rng, crowd) if "people" in options.hazards else None
        fov = options.fov_deg or _USUAL_FOV_DEG
        if options.varied and options.fov_deg is None:
            fov = float(
                np.exp(np.random.default_rng([options.seed, 55]).uniform(*np.log(_VARIED_FOV_DEG)))
            )
        T_scene_camera = self._carried.poses(
            self._moments(np.arange(options.frames) / options.rate, options)
        )
        super().__init__(options, square_camera(options.width, options.height, fov), T_scene_camera)

    def _build(self) -> Mesh:
        return self._interior.mesh

    @functools.cached_property
    def _irradiance(self) -> Float32Array:
        return _illuminated(self.options.seed, "exposure" in self.options.hazards)

    def _moments(self, seconds: FloatArray, options: SimulationOptions) -> FloatArray:
        """Where in the motion the camera is at times ``(N,)``: it is put down in the middle, if wanted."""
        if "stop" not in options.hazards:
            return seconds
        middle = 0.5 * max(options.frames / options.rate - STILL_S, 0.0)
        return seconds - np.clip(seconds - middle, 0.0, STILL_S)

    def _exposures(self, index: int) -> FloatArray:
        options = self.options
        offsets = np.zeros((1, 1))
        if "blur" in options.hazards:
            turned = np.diff(self._T_scene_camera[max(index - 1, 0) : index + 2, :3, 2], axis=0)
            open_s = min(
                _LONGEST_S * self._gain(index) / self._usual_gain,
                2.0 * SHUTTER * 0.9 / options.rate,
            )
            blurred_px = (
                np.linalg.norm(turned, axis=1).max() * open_s * options.rate * self.camera.fx
            )
            samples = int(np.clip(blurred_px / 4.0, 3, 12))
            offsets = offsets + open_s * ((np.arange(samples)[:, None] + 0.5) / samples - 0.5)
        if options.readout_s:
            rows = (np.arange(options.height) + 0.5) / options.height - 0.5
            offsets = offsets + options.readout_s * rows
        moments = self._moments(index / options.rate + offsets.ravel(), options)
        poses = self._carried.poses(np.maximum(moments, 0.0)).reshape(*offsets.shape, 4, 4)
        return poses[:, 0] if offsets.shape[1] == 1 else poses

    def _moving(self, index: int) -> list[Mesh]:
        if self._people is None:
            return []
        now = index / self.options.rate
        T_scene_people = [
            _standing(self._carried, now + _AHEAD_S),
            *(_standing(walk, now) for walk in self._walks),
        ]
        camera = self._T_scene_camera[index, :2, 3]
        far = [np.linalg.norm(T[:2, 3] - camera) > _NEAREST_M for T in T_scene_people]
        return self._people.placed(
            {number: T for number, T in enumerate(T_scene_people) if far[number]}
        )

    def _background(self, directions: Float32Array) -> Float32Array:
        return np.zeros_like(directions)

    def _shade(
        self,
        surfaces: list[Surface],
        number: int,
        hits: Hits,
        rays: Float32Array,
        pixels: NDArray[np.int64],
    ) -> Float32Array:
        rgb = surfaces[number].unlit(hits, self.camera.fx)
        if number > 0:  # people are as bright as what is below them
            down = rays.copy()
            down[:, :3] += rays[:, 3:] * hits.depth[:, None]
            down[:, 3:] = (0.0, 0.0, -1.0)
            hits_below = self._still.cast(down)
            below = np.minimum(
                hits_below["primitive_ids"].astype(np.int64), self._irradiance.shape[1] - 1
            )
            return np.asarray(
                rgb * self._irradiance[:, below].mean(axis=0) * (0.85 + 0.15 * hits.normals[2])
            )
        return np.asarray(rgb * self._light(hits.triangle, hits.barycentric))

    def _light(self, triangle: NDArray[np.int64], barycentric: Float32Array) -> Float32Array:
        """Irradiance at points of triangles ``(N,)``; of what glows, its own light."""
        corners = np.take(self._irradiance, triangle, axis=1)
        light = (
            corners[0]
            + barycentric[0] * (corners[1] - corners[0])
            + barycentric[1] * (corners[2] - corners[0])
        )
        glow = _GLOW[np.take(self._still.mesh.material, triangle)]
        return np.asarray(np.where(glow > 0.0, glow, light))

    def _develop(self, rgb: Float32Array, index: int) -> Float32Array:
        """Gain, lens blur and noise."""
        gain = self._gain(index)
        rgb = through_lens(rgb * np.float32(gain))
        if "exposure" in self.options.hazards:
            rng = np.random.default_rng([self.options.seed, 56, index])
            rgb = rgb + rng.standard_normal(rgb.shape, dtype=np.float32) * np.float32(
                0.008 * np.sqrt(gain)
            )
        return rgb

    def _gain(self, index: int) -> float:
        """Of the sensor: the world's own, or one that follows the light of the last second."""
        if "exposure" not in self.options.hazards:
            return self._usual_gain
        last = int(index / self.options.rate / _METER_S)
        read = np.array([self._brightness(max(last - k, 0)) for k in range(_METERED)])
        return float(
            _GREY
            / max(
                (read * np.exp(-_METER_S * np.arange(_METERED) / 0.35)).sum() / _METER_WEIGHT, 0.06
            )
        )

    @functools.cached_property
    def _usual_gain(self) -> float:
        last = int(len(self) / self.options.rate / _METER_S)
        read = [self._brightness(int(tick)) for tick in np.linspace(0, last, _METERED)]
        return float(_GREY / np.median(read))

    @functools.lru_cache(maxsize=256)  # noqa: B019 - a reading is small, and a world is kept for long
    def _brightness(self, tick: int) -> float:
        """Mean of a coarse image without textures, as the camera's meter sees it."""
        moment = self._moments(np.array([tick * _METER_S]), self.options)
        few = self._rays[:: max(len(self._rays) // 400, 1)]
        answer = self._still.cast(place_rays(self._carried.poses(moment)[0], few))
        met = np.isfinite(answer["t_hit"])
        triangle = answer["primitive_ids"][met].astype(np.int64)
        light = self._light(triangle, answer["primitive_uvs"][met].T)
        colours = self._still.mesh.colours[0].mean(axis=0)
        return float(np.minimum(light * colours[self._still.mesh.instance[triangle]], 1.5).mean())


_interior = functools.lru_cache(maxsize=4)(Interior)  # which several motions and hazards share
_GLOW = np.array([GLOWING.get(material, 0.0) for material in Material], dtype=np.float32)
_METER_WEIGHT = float(np.exp(-_METER_S * np.arange(_METERED) / 0.35).sum())


@functools.lru_cache(maxsize=2)
def _illuminated(seed: int, some_are_dim: bool) -> Float32Array:
    """Irradiance in a house, some rooms of which may be dim.

    It is that at the corners of triangles, about 1 below a lamp, ``(3, T)``; they face the side that is seen.
    """
    interior = _interior(seed)
    lights = interior.lights.copy()
    if some_are_dim:
        strength = np.exp(
            np.random.default_rng([seed, 54]).uniform(-1.5, 0.5, len(interior.house.rooms))
        )
        for room, factor in zip(interior.house.rooms, strength):
            lights[room.contains(lights[:, :2]), 3] *= factor
    surface, mesh = Surface(interior.mesh), interior.mesh
    triangles = mesh.triangles.astype(np.int64)
    count = len(mesh.vertices)
    middle, normal = np.zeros((count, 3)), np.zeros((count, 3))
    uses = np.bincount(triangles.ravel(), minlength=count)[:, None]
    for corner in triangles.T:
        np.add.at(middle, corner, mesh.vertices[triangles].mean(axis=1))
        np.add.at(normal, corner, mesh.normals.T)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    middle /= np.maximum(uses, 1)
    points = (
        mesh.vertices + 0.12 * (middle - mesh.vertices) + 0.015 * normal
    )  # out of the corner, off the surface
    direct = np.zeros(len(points))  # the light of the lamps that are seen
    for x, y, z, strength in lights:
        towards = np.array([x, y, z]) - points
        distance = np.linalg.norm(towards, axis=1)
        cosine = (towards * normal).sum(axis=1) / np.maximum(distance, 1e-9)
        near = np.flatnonzero((distance < _REACH_M) & (cosine > 0.0))
        rays = np.hstack([points[near], towards[near]]).astype(np.float32)
        blocked = surface.scene.test_occlusions(
            import_open3d().core.Tensor(rays), 0.0, 0.97
        ).numpy()
        fade = strength * cosine[near] / (1.0 + 0.35 * distance[near] ** 2)
        direct[near] += np.where(blocked, 0.0, fade)
    hit = _around(surface, points, normal)
    shining = np.isin(mesh.material, [int(material) for material in GLOWING])
    total = direct
    for _ in range(_BOUNCES):
        thrown = np.where(shining, 1.2, _ALBEDO * total[triangles].mean(axis=1))
        thrown = np.append(thrown, 0.0)  # for rays that meet nothing
        total = direct + thrown[hit].mean(axis=0)
    return np.ascontiguousarray(total[triangles].T, dtype=np.float32)


def _standing(walk: Carried, seconds: float) -> FloatArray:
    """``T_scene_person`` of whoever walks so, upright on the floor."""
    x, y, _, yaw, _, _ = walk.at(np.array([seconds]))[:, 0]
    c, s = np.cos(yaw), np.sin(yaw)
    return se3.make(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([x, y, -0.1]))


def _around(surface: Surface, points: FloatArray, normals: FloatArray) -> IntArray:
    """Triangles that cosine-weighted rays from points ``(V, 3)`` meet, ``(_RAYS, V)``; -1 where none."""
    turn = np.arange(_RAYS) * 2.39996  # the golden angle
    radius = np.sqrt((np.arange(_RAYS) + 0.5) / _RAYS)
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    side = np.cross(normals, helper)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    other = np.cross(normals, side)
    found = np.empty((_RAYS, len(points)), dtype=np.int64)
    for k, (angle, r) in enumerate(zip(turn, radius)):
        direction = (
            r * np.cos(angle) * side + r * np.sin(angle) * other + np.sqrt(1.0 - r * r) * normals
        )
        answer = surface.cast(np.hstack([points, direction]).astype(np.float32))
        met = np.isfinite(answer["t_hit"])
        found[k] = np.where(met, answer["primitive_ids"].astype(np.int64), -1)
    return found
