"""The street plan: which edges of an irregular grid are streets, and the camera's route over them."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from slam.simulation.geometry import FloatArray
from slam.simulation.variety import StreetKind

Node = tuple[int, int]
BoolArray = NDArray[np.bool_]

MARGIN = 42.0  # depth of the outermost lots, metres
SMALLEST_BLOCK = 22.0  # between two street centres, metres
_ROADS: dict[StreetKind, tuple[float, float, float, tuple[float, float]]] = {  # blocks, side streets, half width
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
    along_x: BoolArray  # whether the edge from node (i, j) to (i + 1, j) is a street, (X - 1, Y)
    along_y: BoolArray  # whether the edge from node (i, j) to (i, j + 1) is a street, (X, Y - 1)
    half_width: float  # of every street, metres
    drive: tuple[Node, ...]  # nodes in the order in which the camera passes them
    kind: StreetKind = "town"  # of streets and what stands beside them

    def node(self, node: Node) -> FloatArray:
        """Plan position of a node, ``(2,)``."""
        return np.array([self.xs[node[0]], self.ys[node[1]]])

    def is_street(self, a: Node, b: Node) -> bool:
        """Whether two neighbouring nodes are joined by a street."""
        i, j = min(a, b)
        if i < 0 or j < 0 or max(a[0], b[0]) >= len(self.xs) or max(a[1], b[1]) >= len(self.ys):
            return False
        return bool(self.along_x[i, j] if a[1] == b[1] else self.along_y[i, j])


def loop_cycle(rng: np.random.Generator, edges: int) -> list[Node]:
    """Outline of a random simply connected set of cells, with left and right corners, of ``edges`` (even, 8 or more).

    Its nodes in order, clockwise or counter-clockwise; the smallest coordinates are zero.
    """
    while True:
        cells = {(0, 0)}
        while len(outline := _outline(cells)) < edges:
            x, y = sorted(cells)[rng.integers(len(cells))]
            dx, dy = ((1, 0), (-1, 0), (0, 1), (0, -1))[rng.integers(4)]
            cells.add((x + dx, y + dy))
        cycle = _trace(outline) if len(outline) == edges else None
        if cycle is None or len({_turn(cycle, k) for k in range(edges)}) < 3:
            continue
        low = np.min(cycle, axis=0)
        nodes = [(int(x - low[0]), int(y - low[1])) for x, y in cycle]
        return nodes[::-1] if rng.random() < 0.5 else nodes


def grid_walk(rng: np.random.Generator, side: int, edges: int, spare: int) -> list[Node]:
    """A walk on ``side`` x ``side`` nodes without U-turns that repeats streets, also in the opposite direction.

    It does so within ``edges``, and has some ``spare`` ones, in case the drive comes so far.
    """
    best: tuple[float, list[Node]] = (-1.0, [])
    for _ in range(300):
        walk = [(int(rng.integers(side)), int(rng.integers(side)))]
        while len(walk) <= edges + spare:
            x, y = walk[-1]
            steps = [(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)]
            steps = [s for s in steps if 0 <= s[0] < side and 0 <= s[1] < side and s not in walk[-2:-1]]
            walk.append(steps[rng.integers(len(steps))])
        driven: set[tuple[Node, Node]] = set()
        same = opposite = 0
        for step in pairwise(walk[: edges + 1]):
            same += step in driven
            opposite += step[::-1] in driven
            driven.add(step)
        score = min(same, 4) + 2.0 * min(opposite, 4) + 0.3 * len({tuple(sorted(step)) for step in driven})
        best = max(best, (score, walk), key=lambda pair: pair[0])
    return best[1]


def town_plan(
    rng: np.random.Generator, drive: list[Node], spacing: float, side_streets: float, kind: StreetKind = "town"
) -> StreetPlan:
    """Lay streets under a drive over nodes, smallest coordinates zero, and some more beside it.

    ``spacing`` is the mean distance of parallel streets in metres, ``side_streets`` the probability that an edge which
    is not driven is a street.
    """
    span = np.max(drive, axis=0)
    lines = [_lines(rng, int(count), spacing) for count in span]
    half_width = float(rng.uniform(4.6, 5.2))
    shifted = [(i + 1, j + 1) for i, j in drive]
    along_x = rng.random((len(lines[0]) - 1, len(lines[1]))) < side_streets
    along_y = rng.random((len(lines[0]), len(lines[1]) - 1)) < side_streets
    along_x[:, [0, -1]] = False
    along_y[[0, -1], :] = False
    for a, b in pairwise(shifted):
        low = min(a, b)
        (along_x if a[1] == b[1] else along_y)[low] = True
    return StreetPlan(lines[0], lines[1], along_x, along_y, half_width, tuple(shifted), kind)


def road_plan(rng: np.random.Generator, length: float, kind: StreetKind = "town") -> StreetPlan:
    """One street along x with side streets, long enough to drive ``length`` metres."""
    shortest, longest, side_streets, widths = _ROADS[kind]
    gaps = rng.uniform(shortest, longest, int(length / shortest) + 3)
    ends = np.cumsum(gaps)
    xs = np.concatenate([[0.0], ends[: int(np.searchsorted(ends, length + 160.0)) + 1]])
    ys = np.array([-MARGIN, 0.0, MARGIN])
    along_x = np.zeros((len(xs) - 1, 3), dtype=bool)
    along_x[:, 1] = True
    along_y = rng.random((len(xs), 2)) < side_streets
    along_y[[0, -1], :] = False
    drive = tuple((i, 1) for i in range(len(xs)))
    return StreetPlan(xs, ys, along_x, along_y, float(rng.uniform(*widths)), drive, kind)


def _lines(rng: np.random.Generator, count: int, spacing: float) -> FloatArray:
    """Grid lines of ``count`` cells plus the margins, ``(count + 3,)``."""
    uneven = min(0.2, max(0.0, 1.0 - SMALLEST_BLOCK / spacing))
    gaps = rng.uniform(1.0 - uneven, 1.0 + uneven, count)
    gaps *= spacing * count / gaps.sum()
    return np.concatenate([[-MARGIN], [0.0], np.cumsum(gaps), [gaps.sum() + MARGIN]])


def _outline(cells: set[Node]) -> dict[tuple[Node, Node], None]:
    """Directed edges around a set of cells, cells on the left."""
    edges: dict[tuple[Node, Node], None] = {}
    for x, y in sorted(cells):
        ring = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)]
        for edge in zip(ring, ring[1:] + ring[:1]):
            if edge[::-1] in edges:
                del edges[edge[::-1]]
            else:
                edges[edge] = None
    return edges


def _trace(outline: dict[tuple[Node, Node], None]) -> list[Node] | None:
    """Chain an outline into one cycle; None if it touches itself or has a hole."""
    following = dict(outline.keys())
    if len(following) < len(outline):
        return None
    first = next(iter(following))
    cycle = [first]
    while (node := following[cycle[-1]]) != first:
        cycle.append(node)
    return cycle if len(cycle) == len(outline) else None


def _turn(cycle: list[Node], k: int) -> int:
    """Sign of the turn at the k-th node: 1 left, -1 right, 0 straight on."""
    before, here, after = np.array(cycle[k - 1]), np.array(cycle[k]), np.array(cycle[(k + 1) % len(cycle)])
    a, b = here - before, after - here
    return int(np.sign(a[0] * b[1] - a[1] * b[0]))
