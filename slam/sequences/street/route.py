"""Camera poses over time: a drive along a street plan, with a car's speed, sway and lane keeping."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.ndimage import gaussian_filter1d

from slam.errors import SequenceError
from slam.sequences.street.geometry import Bend, FloatArray, road_bend, town_bend
from slam.sequences.street.streets import StreetPlan, grid_walk, loop_cycle, road_plan, town_plan

Route = Literal["loop", "grid", "straight"]
ROUTES: tuple[str, ...] = get_args(Route)

STEP = 0.25  # between samples of a path, metres
MEAN_STEP = 0.97  # metres per frame
OVERLAP = 68.0  # how far a loop drives its own start again, metres
SHORTEST_LOOP = 250  # frames
CORNER_RADIUS = 8.0  # of the street's centre line, metres
CRUISE = 1.2  # metres per frame
SLOWEST, FASTEST = 0.45, 1.4  # metres per frame
LATERAL_ACCELERATION = 0.045  # in corners, metres per frame squared (4.5 m/s^2)


@dataclass(frozen=True)
class Drive:
    """Where the camera is at each frame.

    Attributes:
        plan: the streets.
        bend: from plan to street coordinates.
        T_street_camera: ``(N, 4, 4)``; street: x east, y north, z up, metres.
        camera_height_m: of the camera at rest above the road.
        path_street: the driven path on the road every ``STEP`` metres, ``(M, 3)``.
        lane_offset: from the middle of the street to the right, metres.
        sample: where in ``path_street`` each frame is, ``(N,)``.
    """

    plan: StreetPlan
    bend: Bend
    T_street_camera: FloatArray
    camera_height_m: float
    path_street: FloatArray
    lane_offset: float
    sample: FloatArray


def plan_drive(route: Route, frames: int, rng: np.random.Generator, still_frames: int = 0) -> Drive:
    """Lay out streets and drive over them in ``frames`` frames, ``still_frames`` of them standing in the middle.

    Raises:
        SequenceError: too few frames for the route.
    """
    moving = frames - still_frames
    least = SHORTEST_LOOP if route == "loop" and not still_frames else 5
    if moving < least:
        raise SequenceError(f"a {route} needs at least {least + still_frames} frames to drive; got {frames}")
    plan, start = _layout(route, moving, rng)
    lane = float(rng.uniform(1.4, 1.9))
    bend = town_bend(rng) if route != "straight" else road_bend(rng, float(plan.xs[0]), float(plan.xs[-1]))
    path_plan = _right_lane(plan, lane, start)
    path = bend(np.column_stack([path_plan, np.zeros(len(path_plan))]))
    sample = _frame_positions(path, moving, route, rng)
    height = float(rng.uniform(1.5, 1.8))
    T_street_camera = _poses(path, sample, height, rng)
    if still_frames:
        rest = moving // 2
        T_street_camera = np.insert(T_street_camera, [rest] * still_frames, T_street_camera[rest], axis=0)
        sample = np.insert(sample, [rest] * still_frames, sample[rest])
    return Drive(plan, bend, T_street_camera, height, path, lane, sample)


def _layout(route: Route, moving: int, rng: np.random.Generator) -> tuple[StreetPlan, float]:
    """Streets for a route of so many frames, and where on the first edge it starts, as a share."""
    length = moving * MEAN_STEP
    if route == "loop":
        circuit = length - OVERLAP
        edges = int(np.clip(2 * round(circuit / 2 / rng.uniform(30, 52)), 8, 40))
        cycle = loop_cycle(rng, edges)
        again = int(np.ceil((OVERLAP + 8) / (circuit / edges))) + 2
        drive = cycle + [cycle[k % edges] for k in range(again)]
        return town_plan(rng, drive, circuit / edges, 0.35), 0.5
    if route == "grid":
        spacing = rng.uniform(36, 55)
        edges = int(np.ceil(length / spacing)) + 2
        return town_plan(rng, grid_walk(rng, 4, edges), spacing, 0.3), 0.3
    return road_plan(rng, length * 1.1 + 60), 0.4


def _right_lane(plan: StreetPlan, lane: float, start: float) -> FloatArray:
    """The middle of the right lane along the drive, corners rounded, every ``STEP`` metres, ``(M, 2)``."""
    nodes = np.array([plan.node(node) for node in plan.drive])
    nodes[0] += (nodes[1] - nodes[0]) * start
    nodes[-1] = (nodes[-1] + nodes[-2]) / 2
    along = np.diff(nodes, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    right = np.stack([along[:, 1], -along[:, 0]], axis=1)
    pieces = [nodes[:1] + lane * right[0]]
    for k in range(1, len(nodes) - 1):
        before, after = along[k - 1], along[k]
        turn = before[0] * after[1] - before[1] * after[0]
        if abs(turn) < 0.5:
            pieces.append((nodes[k] + lane * right[k])[None])
            continue
        corner = nodes[k] + lane * (right[k - 1] + right[k])
        radius = max(CORNER_RADIUS + (lane if turn > 0 else -lane), 4.5)
        centre = corner + radius * (after - before)
        angle = np.linspace(0, np.pi / 2, 40)[:, None]
        pieces.append(centre - after * radius * np.cos(angle) + before * radius * np.sin(angle))
    pieces.append(nodes[-1:] + lane * right[-1])
    points = np.concatenate(pieces)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points = points[np.concatenate([[True], steps > 1e-6])]
    distance = np.concatenate([[0.0], np.cumsum(steps[steps > 1e-6])])
    even = np.arange(0, distance[-1], STEP)
    lane_points = np.stack([np.interp(even, distance, points[:, axis]) for axis in (0, 1)], axis=1)
    smooth: FloatArray = gaussian_filter1d(lane_points, 8, axis=0, mode="nearest")
    return smooth


def _frame_positions(path: FloatArray, moving: int, route: Route, rng: np.random.Generator) -> FloatArray:
    """Index into the path at each frame ``(moving,)``: slower in corners, never steady on the straight."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    tangent = np.gradient(path, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    curvature = gaussian_filter1d(np.abs(np.gradient(heading)) / STEP, 8)
    mood = gaussian_filter1d(rng.normal(size=len(path)), 160)
    wish = CRUISE * (1 + 0.08 * mood / max(float(mood.std()), 1e-9))
    speed = np.minimum(wish, np.sqrt(LATERAL_ACCELERATION / np.maximum(curvature, 1e-4)))
    speed = np.clip(gaussian_filter1d(speed, 24), SLOWEST, FASTEST)
    times = np.concatenate([[0.0], np.cumsum(2 * steps / (speed[1:] + speed[:-1]))])
    if route == "loop":
        end = min(int(np.searchsorted(distance, moving * MEAN_STEP)), len(times) - 1)
        times = times * ((moving - 1) / times[end])
    if times[-1] < moving - 1 - 1e-6:
        raise SequenceError(f"a {route} of {moving} frames outran its streets; choose another seed")
    return np.interp(np.arange(moving), times, np.arange(len(times)))


def _poses(path: FloatArray, sample: FloatArray, height: float, rng: np.random.Generator) -> FloatArray:
    """``T_street_camera`` ``(N, 4, 4)``: on the path, with suspension, steering and lane drift."""
    count = len(sample)
    rows = np.arange(len(path))
    tangent = np.gradient(path, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    position = np.stack([np.interp(sample, rows, path[:, axis]) for axis in range(3)], axis=1)
    slope = np.interp(sample, rows, gaussian_filter1d(tangent[:, 2] / STEP, 12))
    yaw = np.interp(sample, rows, heading)
    drift = _wander(rng, count, 25, 0.12)
    position += np.stack([-np.sin(yaw) * drift, np.cos(yaw) * drift, height + _wander(rng, count, 4, 0.015)], axis=1)
    yaw = yaw + _wander(rng, count, 12, np.deg2rad(0.8))
    pitch = slope + _wander(rng, count, 4, np.deg2rad(0.35)) + rng.normal(0, np.deg2rad(0.5))
    roll = _wander(rng, count, 5, np.deg2rad(0.3))
    forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=1)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    T_street_camera = np.tile(np.eye(4), (count, 1, 1))
    T_street_camera[:, :3, 0] = c * right + s * down
    T_street_camera[:, :3, 1] = c * down - s * right
    T_street_camera[:, :3, 2] = forward
    T_street_camera[:, :3, 3] = position
    return T_street_camera


def _wander(rng: np.random.Generator, count: int, correlation: float, sigma: float) -> FloatArray:
    """Smooth noise ``(count,)`` of standard deviation ``sigma``, correlated over so many frames."""
    noise = gaussian_filter1d(rng.normal(size=count + 8 * int(correlation)), correlation)
    wander: FloatArray = noise[4 * int(correlation) :][:count] * sigma / noise.std()
    return wander
