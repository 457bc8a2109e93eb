"""The street plan: which edges of an irregular grid are streets, and the camera's poses over time.

A drive along the plan has a car's speed, sway and lane keeping.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d

from slam.geometry import se3
from slam.geometry.se3 import BoolArray, FloatArray
from slam.runtime.errors import SequenceError
from slam.simulation.geometry import Bend, luck, road_bend, town_bend, unit
from slam.simulation.options import StreetKind, Variety

Node = tuple[int, int]

STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))  # from a node to its neighbours
KERB = 0.13  # height of pavements above the road, metres
STEP = 0.25  # between samples of a path in the plan, metres
OVERLAP = 67.0  # length of the start that a loop drives again, metres
START = 25.0  # of a lone road, so that there is something behind the camera, metres
CRUISE = 1.1  # metres per frame
SLOWEST = 0.5  # metres per frame, except around a stop
LATERAL_ACCELERATION = 0.045  # in corners, metres per frame squared (4.5 m/s^2)
ACCELERATION = 0.022  # along the road, metres per frame squared
FEWEST_LOOP_FRAMES = 250
MARGIN = 42.0  # depth of the outermost lots, metres
SMALLEST_BLOCK = 22.0  # between two street centres, metres
# shortest and longest block, metres; share of side streets; lowest and highest half width, metres
_ROADS: dict[StreetKind, tuple[float, float, float, tuple[float, float]]] = {
    "town": (38.0, 85.0, 0.45, (4.6, 5.2)),
    "avenue": (50.0, 110.0, 0.3, (4.6, 7.0)),
    "country": (90.0, 180.0, 0.3, (2.9, 4.2)),
    "motorway": (120.0, 200.0, 0.0, (9.0, 14.0)),
}


@dataclass(frozen=True)
class StreetPlan:
    """Streets in plan coordinates (metres, x east, y north, z = 0 the road)."""

    xs: FloatArray  # x of the grid lines, the first and last of which are the edge of town, (X,)
    ys: FloatArray  # y of the grid lines, likewise, (Y,)
    # whether the edges from node (i, j) to (i + 1, j), and to (i, j + 1), are streets, (2, X, Y)
    streets: BoolArray
    half_width: float  # of every street, metres
    drive: tuple[Node, ...]  # nodes in the order in which the camera passes them
    kind: StreetKind  # of streets and what stands beside them

    @property
    def driven(self) -> FloatArray:
        """Plan positions of the nodes of the drive ``(n, 2)``."""
        i, j = np.transpose(self.drive)
        return np.stack([self.xs[i], self.ys[j]], axis=1)

    def is_street(self, a: Node, b: Node) -> bool:
        """Whether two neighbouring nodes are joined by a street."""
        i, j = min(a, b)  # -1 is the last one, from which no edge leads on
        return bool(self.streets[int(a[0] == b[0]), i, j])


def loop_cycle(rng: np.random.Generator, edges: int) -> list[Node]:
    """Outline of a random simply connected set of cells, with left and right corners.

    Args:
        rng: draws it.
        edges: of the outline, an even number of 8 or more.

    Returns:
        Its nodes in order, clockwise or counter-clockwise; the smallest coordinates are zero.
    """
    while True:
        cells = {(0, 0)}
        while len(outline := _outline(cells)) < edges:
            x, y = sorted(cells)[rng.integers(len(cells))]
            dx, dy = STEPS[rng.integers(4)]
            cells.add((x + dx, y + dy))
        cycle = _trace(outline) if len(outline) == edges else None
        if cycle is None:
            continue
        steps = np.diff([*cycle, *cycle[:2]], axis=0)
        # 1 left, -1 right, 0 straight on
        turns = np.sign(steps[:-1, 0] * steps[1:, 1] - steps[:-1, 1] * steps[1:, 0])
        if len(np.unique(turns)) < 3:
            continue
        low = np.min(cycle, axis=0)
        nodes = [(int(x - low[0]), int(y - low[1])) for x, y in cycle]
        return nodes[::-1] if rng.random() < 0.5 else nodes


def grid_walk(rng: np.random.Generator, side: int, edges: int, spare: int) -> list[Node]:
    """A walk without U-turns that repeats streets, also in the opposite direction.

    Args:
        rng: draws it.
        side: of the square of nodes that it is on.
        edges: within which it repeats streets.
        spare: further edges, in case the drive comes so far.
    """
    best: tuple[float, list[Node]] = (-1.0, [])
    for _ in range(300):
        walk = [(int(rng.integers(side)), int(rng.integers(side)))]
        while len(walk) <= edges + spare:
            x, y = walk[-1]
            steps = [(x + dx, y + dy) for dx, dy in STEPS]
            steps = [s for s in steps if min(s) >= 0 and max(s) < side and s not in walk[-2:-1]]
            walk.append(steps[rng.integers(len(steps))])
        driven: set[tuple[Node, Node]] = set()
        same = opposite = 0
        for step in pairwise(walk[: edges + 1]):
            same += step in driven
            opposite += step[::-1] in driven
            driven.add(step)
        score = (
            min(same, 4)
            + 2.0 * min(opposite, 4)
            + 0.3 * len({tuple(sorted(step)) for step in driven})
        )
        best = max(best, (score, walk), key=lambda pair: pair[0])
    return best[1]


def town_plan(
    rng: np.random.Generator,
    drive: list[Node],
    spacing: float,
    side_streets: float,
    kind: StreetKind,
) -> StreetPlan:
    """Lay streets under a drive over nodes, smallest coordinates zero, and some more beside it.

    Args:
        rng: draws what is not driven.
        drive: the nodes in the order in which the camera passes them.
        spacing: mean distance of parallel streets, metres.
        side_streets: the probability that an edge which is not driven is a street.
        kind: of the streets.
    """
    span = np.max(drive, axis=0)
    lines = [_lines(rng, int(count), spacing) for count in span]
    half_width = rng.uniform(4.6, 5.2)
    shifted = [(i + 1, j + 1) for i, j in drive]
    streets = np.zeros((2, len(lines[0]), len(lines[1])), dtype=bool)
    streets[0, :-1] = rng.random(streets[0, :-1].shape) < side_streets
    streets[1, :, :-1] = rng.random(streets[1, :, :-1].shape) < side_streets
    streets[0, :, [0, -1]] = streets[1, [0, -1]] = False
    for a, b in pairwise(shifted):
        streets[(int(a[0] == b[0]), *min(a, b))] = True
    return StreetPlan(lines[0], lines[1], streets, half_width, tuple(shifted), kind)


def road_plan(rng: np.random.Generator, length: float, kind: StreetKind) -> StreetPlan:
    """One street along x with side streets, long enough to drive ``length`` metres."""
    shortest, longest, side_streets, widths = _ROADS[kind]
    gaps = rng.uniform(shortest, longest, int(length / shortest) + 3)
    ends = np.cumsum(gaps)
    xs = np.concatenate([[0.0], ends[: int(np.searchsorted(ends, length + 160.0)) + 1]])
    ys = np.array([-MARGIN, 0.0, MARGIN])
    streets = np.zeros((2, len(xs), 3), dtype=bool)
    streets[0, :-1, 1] = True
    streets[1, :, :-1] = rng.random((len(xs), 2)) < side_streets
    streets[1, [0, -1]] = False
    drive = tuple((i, 1) for i in range(len(xs)))
    return StreetPlan(xs, ys, streets, rng.uniform(*widths), drive, kind)


def _lines(rng: np.random.Generator, count: int, spacing: float) -> FloatArray:
    """Grid lines of ``count`` cells plus the margins, ``(count + 3,)``."""
    uneven = min(0.2, max(0.0, 1.0 - SMALLEST_BLOCK / spacing))
    gaps = rng.uniform(1.0 - uneven, 1.0 + uneven, count)
    gaps *= spacing * count / gaps.sum()
    return np.concatenate([[-MARGIN], [0.0], np.cumsum(gaps), [gaps.sum() + MARGIN]])


def _outline(cells: set[Node]) -> list[tuple[Node, Node]]:
    """Directed edges around a set of cells, cells on the left."""
    edges: dict[tuple[Node, Node], None] = {}
    for x, y in sorted(cells):
        ring = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)]
        edges |= dict.fromkeys(zip(ring, ring[1:] + ring[:1]))
    return [edge for edge in edges if edge[::-1] not in edges]


def _trace(outline: list[tuple[Node, Node]]) -> list[Node] | None:
    """Chain an outline into one cycle; None if it touches itself or has a hole."""
    following = dict(outline)
    if len(following) < len(outline):
        return None
    first = next(iter(following))
    cycle = [first]
    while (node := following[cycle[-1]]) != first:
        cycle.append(node)
    return cycle if len(cycle) == len(outline) else None


@dataclass(frozen=True)
class Route:
    """The camera's trajectory through a street plan."""

    plan: StreetPlan  # the streets
    bend: Bend  # from plan to street coordinates
    T_street_camera: FloatArray  # (N, 4, 4); street: x east, y north, z up, metres
    camera_height_m: float  # of the camera at rest above the road
    # the driven path on the road, at least STEP metres of plan each, (M, 3)
    lane_street: FloatArray
    lane_offset_m: float  # from the middle of the street to the right
    sample: FloatArray  # where in lane_street each frame is, (N,)


def plan_route(route: str, frames: int, seed: int, still_frames: int, variety: Variety) -> Route:
    """Lay out streets and a drive over them.

    Args:
        route: a ``loop`` drives its start again, a ``grid`` repeats streets in both directions
            (with about 250 frames), and ``straight`` never comes back.
        frames: of the drive.
        seed: of every draw.
        still_frames: how many of the frames stand in the middle.
        variety: of the streets and the camera.

    Raises:
        SequenceError: if there are too few frames for the route.
    """
    moving = frames - still_frames
    if moving < 2:
        raise SequenceError(f"this drive needs at least {still_frames + 2} frames; got {frames}")
    if route == "loop" and frames < FEWEST_LOOP_FRAMES:
        raise SequenceError(
            f"a loop closes within {FEWEST_LOOP_FRAMES} frames or more; got {frames} frames"
        )
    stops = still_frames > 0
    plan, bend, lane_plan = _layout(route, moving, seed, stops, variety)
    arrival = _arrival(bend, lane_plan, stops, moving)
    if route == "loop":
        arrival *= (moving - 1.0) / arrival[-1]
    rng = luck(seed, 2)
    usual_m = rng.uniform(1.5, 1.8)
    camera_height_m = variety.height_m or usual_m
    sample = np.interp(np.arange(moving), arrival, np.arange(len(arrival)))
    T_street_camera = _poses(rng, bend, lane_plan, sample, camera_height_m, variety)
    if stops:
        rest = int(np.argmin(np.diff(sample)))
        order = np.insert(np.arange(moving), rest, [rest] * still_frames)
        sample, T_street_camera = sample[order], T_street_camera[order]
    lane_street, offset = bend(_level(lane_plan)), _lane_offset(plan, seed)
    return Route(plan, bend, T_street_camera, camera_height_m, lane_street, offset, sample)


def _level(points_plan: FloatArray) -> FloatArray:
    """Points ``(N, 2)`` on the road, ``(N, 3)``."""
    return np.insert(points_plan, 2, 0.0, axis=-1)


def _right(ahead: FloatArray) -> FloatArray:
    """To the right of directions ``(N, 2)`` of the plan."""
    return ahead[:, ::-1] * (1.0, -1.0)


def _layout(
    route: str, moving: int, seed: int, stops: bool, variety: Variety
) -> tuple[StreetPlan, Bend, FloatArray]:
    """Streets, their bend, and the lane to drive ``(M, 2)``, long enough for ``moving`` frames."""
    rng = luck(seed, 0)
    kind, hills = variety.kind, variety.hills
    if route == "straight":
        end = START + 1.25 * moving + 5.0
        plan = road_plan(rng, end, kind)
        bend = road_bend(luck(seed, 1), plan.xs[0] - 200.0, plan.xs[-1] + 200.0, hills)
        return plan, bend, _lane(plan, seed)[int(START / STEP) : int(end / STEP)]
    bend = town_bend(luck(seed, 1), hills)
    if route == "grid":
        side = 3 if moving < 500 else 4 if moving < 1200 else 5
        spacing = (
            24.0 if moving < 330 else 30.0 if moving < 500 else 40.0 if moving < 1200 else 52.0
        )
        walk = grid_walk(
            rng, side, int(0.95 * moving / spacing), spare=int(0.35 * moving / spacing) + 2
        )
        plan = town_plan(rng, walk, spacing, side_streets=0.6, kind=kind)
        return plan, bend, _lane(plan, seed)[int(5.0 / STEP) :]
    edges = max(8, 2 * round((0.95 * moving - OVERLAP) / 84.0))
    spacing = 36.0
    for _ in range(8):
        rng = luck(seed, 0)
        cycle = loop_cycle(rng, edges)
        plan = town_plan(rng, cycle + cycle + cycle[:1], spacing, side_streets=0.35, kind=kind)
        # around a cycle that is driven twice, cut off ``OVERLAP`` metres after its start is met
        first, second = plan.driven[:2]
        lane_plan = _lane(plan, seed)[int(0.5 * np.linalg.norm(second - first) / STEP) :]
        away = np.linalg.norm(lane_plan - lane_plan[0], axis=1)
        met = int(60.0 / STEP)
        met += int(np.argmax(away[met:] < 2.0))
        met += int(np.argmin(away[met : met + int(8.0 / STEP)]))
        lane_plan = lane_plan[: met + int(OVERLAP / STEP) + 1]
        stretch = (moving - 1.0) / _arrival(bend, lane_plan, stops, moving)[-1]
        if abs(stretch - 1.0) < 0.004:
            break
        spacing = max(SMALLEST_BLOCK, spacing * stretch**1.2)
    return plan, bend, lane_plan


def _lane_offset(plan: StreetPlan, seed: int) -> float:
    """How far right of the middle of the street the car drives, metres."""
    return luck(seed, 4).uniform(0.33, 0.38) * plan.half_width


def _lane(plan: StreetPlan, seed: int) -> FloatArray:
    """The whole driven path ``(M, 2)``: right-hand lane, rounded corners and a little drift."""
    rng = luck(seed, 3)
    nodes = plan.driven
    offset = _lane_offset(plan, seed)
    ahead = unit(np.diff(nodes, axis=0))
    right = _right(ahead)
    turns = ahead[:-1, 0] * ahead[1:, 1] - ahead[:-1, 1] * ahead[1:, 0]
    sideways = np.concatenate([right, right[-1:]])
    sideways[1:-1] += right[:-1] * (np.abs(turns) > 0.5)[:, None]
    corners = nodes + offset * sideways
    rounded: list[FloatArray] = []
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:]):
        rounded += _corner(rng, before, corner, after)
    path = _resample(np.stack([corners[0], *rounded, corners[-1]]))
    path = gaussian_filter1d(path, 1.6 / STEP, axis=0, mode="nearest")
    tangent = unit(np.gradient(path, axis=0))
    drift = gaussian_filter1d(rng.standard_normal(len(path)), 14.0 / STEP)
    drift *= 0.13 / max(drift.std(), 1e-9)
    path += np.clip(drift, -0.28, 0.28)[:, None] * _right(tangent)
    return _resample(path)


def _corner(
    rng: np.random.Generator, before: FloatArray, corner: FloatArray, after: FloatArray
) -> list[FloatArray]:
    """An arc of 8.5 to 11 m radius, less where edges are short; the corner alone if straight on."""
    a, b = before - corner, after - corner
    lengths = np.linalg.norm([a, b], axis=1)
    a, b = np.stack([a, b]) / lengths[:, None]
    wish = rng.uniform(8.5, 11.0)
    if a @ b < -0.5:
        return [corner]
    radius = min(wish, 0.49 * lengths.min())
    centre = corner + radius * (a + b)
    return [
        centre - radius * (np.cos(t) * b + np.sin(t) * a) for t in np.linspace(0.0, np.pi / 2.0, 12)
    ]


def _resample(path: FloatArray) -> FloatArray:
    """Points every ``STEP`` metres along a polyline."""
    length = se3.distance_along(path)
    along = np.arange(0.0, length[-1], STEP)
    return se3.interpolated(along, length, path)


def _arrival(bend: Bend, lane_plan: FloatArray, stops: bool, moving: int) -> FloatArray:
    """Frame number at each point of a lane: slow in corners, acceleration bounded as a car's."""
    points = bend(_level(lane_plan))
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    tangent = np.gradient(points[:, :2], axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    curvature = np.abs(gaussian_filter1d(np.gradient(heading), 4.0)) / step.mean()
    along = np.cumsum(step)
    cruise = CRUISE * (1.0 + 0.12 * np.sin(along / 23.0) * np.sin(along / 61.0 + 1.0))
    speed = np.clip(
        np.sqrt(LATERAL_ACCELERATION / np.maximum(curvature[1:], 1e-4)), SLOWEST, cruise
    )
    if stops:
        rest = 0.5 * min(along[-1], 0.9 * moving)
        speed = np.minimum(speed, 0.08 + np.sqrt(2.5 * ACCELERATION * np.abs(along - rest)))
    for speeds, steps in ((speed, step), (speed[::-1], step[::-1])):  # speeding up, and braking
        for k in range(1, len(speeds)):
            fastest = np.sqrt(speeds[k - 1] ** 2 + 2.0 * ACCELERATION * steps[k])
            speeds[k] = min(speeds[k], fastest)
    return np.concatenate([[0.0], np.cumsum(step / speed)])


def _poses(
    rng: np.random.Generator,
    bend: Bend,
    lane_plan: FloatArray,
    sample: FloatArray,
    height_m: float,
    variety: Variety,
) -> FloatArray:
    """``T_street_camera`` ``(N, 4, 4)`` at fractional lane points ``sample`` ``(N,)``, suspended."""
    rows = np.arange(len(lane_plan))
    direction = gaussian_filter1d(np.gradient(lane_plan, axis=0), 4.0, axis=0)
    tangent = unit(se3.interpolated(sample, rows, direction))
    at, ahead = _level(se3.interpolated(sample, rows, lane_plan)), _level(tangent)
    across = _level(_right(tangent))
    forward = unit(bend(at + ahead) - bend(at - ahead))
    right = bend(at + across) - bend(at - across)
    right -= (right * forward).sum(axis=1, keepdims=True) * forward
    right = unit(right)
    down = np.cross(forward, right)
    # suspension: pitch, yaw and roll about x, y, z in radians and height in metres, correlated in
    # time, (N, 4)
    white = rng.standard_normal((len(at) + 60, 4))
    slow = gaussian_filter1d(white, 8.0, axis=0) * np.sqrt(3.54 * 8.0)
    fast = gaussian_filter1d(white, 2.0, axis=0) * np.sqrt(3.54 * 2.0)
    mixed = (0.8 * slow + 0.6 * fast)[30:-30]
    sizes = np.array([*np.deg2rad([0.3, 0.2, 0.3]), 0.012])
    suspension = np.clip(mixed, -2.2, 2.2) * sizes
    # nobody mounts a camera level
    suspension[:, 0] += np.deg2rad(rng.uniform(-0.8, 0.8)) - variety.pitch
    suspension[:, 2] += variety.roll
    position = bend(at) - (height_m + suspension[:, 3:]) * down
    T_street_level = se3.make(np.stack([right, down, forward], axis=2), position)
    return T_street_level @ se3.from_rotation_vector(suspension[:, :3], np.zeros((len(at), 3)))
