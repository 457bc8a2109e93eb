"""Surfaces of a street plan: roads, pavements, lots and the objects on them."""

import copy

import numpy as np

from slam.geometry import se3
from slam.simulation import objects
from slam.simulation.geometry import Bend, Mesh, luck
from slam.simulation.open_land import open_land
from slam.simulation.route import KERB, STEPS, Node, StreetPlan
from slam.simulation.shapes import Rectangle, Site, grid_over, lattice

LANE = 3.6  # width on a motorway, metres
ROUNDING = 5.0  # radius of kerbs at corners, metres


def build_town(plan: StreetPlan, bend: Bend, seed: int, varied: bool = False) -> Mesh:
    """Every static surface of the world, in street coordinates.

    Args:
        plan: the streets.
        bend: from the plan to street coordinates.
        seed: of the world.
        varied: whether there are fences, posts and people as well.
    """
    rng = luck(seed, 10)
    town = _Town(plan, rng, luck(seed, 11) if varied else None)
    town.ground()
    for i in range(len(plan.xs) - 1):
        for j in range(len(plan.ys) - 1):
            town.block(i, j)
    if plan.kind == "motorway":  # a barrier between the carriageways
        start, end = plan.xs[[0, -1]]
        objects.barrier(town.site.moved(start), end - start, rng.random() < 0.5)
    town.backdrop()
    return town.site.finish(bend)


class _Town:
    """The mesh under construction, with the colours and proportions of one world."""

    def __init__(
        self, plan: StreetPlan, rng: np.random.Generator, more: np.random.Generator | None
    ) -> None:
        self.plan = plan
        self.rng = rng
        self.more = more
        self.site = site = Site(rng)
        self.density = rng.uniform(0.5, 0.9)  # of buildings
        self.parking = rng.uniform(0.1, 0.6)  # of cars along the kerb
        self.greenery = rng.uniform(0.25, 0.8)
        self.pavement_width = rng.uniform(1.6, 2.4)
        self.tallness = 1.0  # of trees at the kerb
        self.open = plan.kind in ("country", "motorway")  # no houses, no pavements
        self.foot = KERB - (0.1 if more is None else 0.6)  # of houses, below the ground on hills
        grey = site.colour("asphalt")
        stone = site.colour("pavement")
        turf = site.colour("grass")
        paint = (0.80, 0.80, 0.76)
        dash = rng.uniform(3.0, 6.0)
        fraction = rng.uniform(0.35, 0.6)
        edged = rng.random() < 0.7
        lanes = LANE if plan.kind == "motorway" else 0.0
        smooth = 0.0 if more is None else more.uniform(0.2, 0.85)
        lines = (plan.half_width, dash, fraction, edged, lanes, smooth)
        self.asphalt = site.instance("asphalt", grey, paint, lines)
        self.junction = site.instance("junction", grey, paint, lines)
        slab = rng.uniform(0.5, 1.2)
        self.pavement = site.instance("pavement", stone, 0.42, (slab, 0.035))
        self.kerb = site.instance("kerb", 1.15 * stone, 0.6 * stone)
        self.grass = site.instance("grass", turf, 0.55)
        self.gravel = site.instance("gravel", 0.9 * stone, 0.5 * stone)
        if self.open:
            self.pavement = self.kerb = self.grass if rng.random() < 0.6 else self.gravel
        if plan.kind == "avenue":
            self.greenery, self.tallness = 2.0, 1.6

    def ground(self) -> None:
        """Roads, junctions, and a wide meadow under it all."""
        xs, ys = self.plan.xs.tolist(), self.plan.ys.tolist()
        around = (xs[0] - 160.0, ys[0] - 160.0, xs[-1] + 160.0, ys[-1] + 160.0)
        self._slab(around, -0.25, self.grass, 8.0)
        half = self.plan.half_width
        reach = half + ROUNDING
        for i, x in enumerate(xs):
            for j, y in enumerate(ys):
                if i + 1 < len(xs):
                    self._corridor((x + half, y - half, xs[i + 1] - half, y + half), (i, j))
                if j + 1 < len(ys):
                    self._corridor((x - half, y + half, x + half, ys[j + 1] - half), (i, j), True)
                crossed = any(self.plan.is_street((i, j), (i + di, j + dj)) for di, dj in STEPS)
                rectangle = (x - half, y - half, x + half, y + half)
                if not crossed:
                    self._slab(rectangle, KERB, self.grass)
                    continue
                self._slab(rectangle, 0.0, self.junction)
                # asphalt outside the rounded kerbs, a hair lower where it runs below the blocks
                for x0, x1 in ((x - reach, x - half), (x + half, x + reach)):
                    for y0, y1 in ((y - reach, y - half), (y + half, y + reach)):
                        self._slab((x0, y0, x1, y1), -0.005, self.junction)

    def _corridor(self, rectangle: Rectangle, start: Node, north: bool = False) -> None:
        """A stretch of road from a junction east or north, or the grass that lies there instead."""
        x0, y0, x1, y1 = rectangle
        if not self.plan.is_street(start, (start[0] + (not north), start[1] + north)):
            self._slab(rectangle, KERB, self.grass)
            return
        if north:
            points, length = grid_over((y0, x0, y1, x1), 0.0, 2.0)[..., [1, 0, 2]], y1 - y0
        else:
            points, length = grid_over(rectangle, 0.0, 2.0), x1 - x0
        rows, columns = points.shape[:2]
        half = self.plan.half_width
        uv = lattice(np.linspace(0.0, length, columns), np.linspace(-half, half, rows))
        self.site.patch(points, uv, self.asphalt)

    def _slab(self, rectangle: Rectangle, z: float, instance: int, step: float = 3.0) -> None:
        """A level rectangle, textured by its plan coordinates."""
        points = grid_over(rectangle, z, step)
        self.site.patch(points, points[..., :2], instance)

    def block(self, i: int, j: int) -> None:
        """One cell of the grid: pavement with kerbs around it, lots inside."""
        plan, half = self.plan, self.plan.half_width
        x0, x1 = plan.xs[i] + half, plan.xs[i + 1] - half
        y0, y1 = plan.ys[j] + half, plan.ys[j + 1] - half
        nodes = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
        # south, east, north, west
        sides = [plan.is_street(*edge) for edge in zip(nodes, nodes[1:] + nodes[:1])]
        width = self.pavement_width
        inner = (x0 + width, y0 + width, x1 - width, y1 - width)
        self._pavement((x0, y0, x1, y1), inner, sides)
        if self.open:
            open_land(self.site, plan.kind, self.grass, inner, sides)
            return
        self._slab(inner, KERB, self.grass if self.rng.random() < 0.7 else self.gravel)
        for number in np.flatnonzero(sides):
            self._furnish(*self.site.side((x0, y0, x1, y1), number))
        self._split(inner, inner, sides)

    def _pavement(self, outer: Rectangle, inner: Rectangle, sides: list[bool]) -> None:
        """A ring of paving between a rounded outline and the lots, and the kerb below its edge."""
        rim = []
        for number in range(4):
            edge, length = self.site.side(outer, number)
            radius = ROUNDING if sides[number] and sides[number - 1] else 0.01
            for angle in np.linspace(0.0, np.pi / 2.0, 6):
                along, across = radius * (1.0 - np.array([np.cos(angle), np.sin(angle)]))
                rim.append(edge.moved(along, across))
            rim += map(edge.moved, np.arange(ROUNDING + 2.0, length - ROUNDING - 1.0, 2.5).tolist())
        outline = np.stack([spot.origin for spot in [*rim, rim[0]]])[:, :2]
        inside = np.clip(outline, [inner[0], inner[1]], [inner[2], inner[3]])
        ring = np.insert([outline, inside], 2, KERB, axis=-1)
        self.site.patch(ring, ring[..., :2], self.pavement)
        around = se3.distance_along(outline)
        step = ring[[0, 0]].copy()
        step[0, :, 2] = -0.1
        self.site.patch(step, lattice(around, (-0.1, KERB)), self.kerb)
        lip = ring[[0, 0]].copy()
        lip[..., 2] += 0.004
        towards = inside - outline
        lip[1, :, :2] += (
            0.16 * towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 0.16)
        )
        self.site.patch(lip, lattice(around, (0.0, 0.16)), self.kerb)

    def _furnish(self, kerb: Site, length: float) -> None:
        """Trees, lamps and signs along a kerb with its block on the left, and cars before it."""
        rng = self.rng
        along = 6.0
        while along < length - 6.0:
            spot = kerb.moved(along, rng.uniform(0.55, 1.0))
            kind = rng.random()
            if kind < 0.45 * self.greenery:
                objects.tree(spot, rng.uniform(4.0, 8.0) * self.tallness)
            elif kind < 0.55:
                objects.lamp(spot)
            elif kind < 0.72:
                objects.sign(spot)
            along += rng.uniform(4.0, 11.0)
        along = 6.5
        while along < length - 6.5:
            if rng.random() < self.parking:
                objects.car(kerb.moved(along, -0.95, turn=rng.normal(0.0, 0.03)))
            along += rng.uniform(5.4, 7.5)
        if self.more is None:
            return
        # a fence along a part of the kerb, thin posts, and people on the pavement
        kerb = copy.copy(kerb)
        rng = kerb.rng = self.more
        if rng.random() < 0.45 and length > 16.0:
            first, last = np.sort(rng.uniform(6.0, length - 6.0, 2))
            objects.fence(kerb.moved(first, rng.uniform(0.2, 0.8), KERB), last - first)
        for _ in range(rng.poisson(length / 14.0)):
            spot = kerb.moved(rng.uniform(5.0, max(length - 5.0, 6.0)), rng.uniform(-0.8, 1.6))
            (objects.person if rng.random() < 0.6 else objects.post)(spot)

    def _split(self, lot: Rectangle, inner: Rectangle, sides: list[bool]) -> None:
        """Cut a lot in two until each piece is of the size of a house."""
        x0, y0, x1, y1 = lot
        width, depth = x1 - x0, y1 - y0
        if max(width, depth) > 17.0:
            cut = self.rng.uniform(0.4, 0.6)
            x, y = (x0 + cut * width, y1) if width > depth else (x1, y0 + cut * depth)
            self._split((x0, y0, x, y), inner, sides)
            self._split((x, y0, x1, y1) if width > depth else (x0, y, x1, y1), inner, sides)
            return
        touches = np.roll(np.equal(lot, inner), -1)
        self._lot(lot, np.flatnonzero(touches & sides).tolist())

    def _lot(self, lot: Rectangle, facing: list[int]) -> None:
        """Build on a lot, or leave it open.

        ``facing`` lists its sides at a street: 0 south, 1 east, 2 north, 3 west.
        """
        rng, (x0, y0, x1, y1) = self.rng, lot
        if min(x1 - x0, y1 - y0) > 5.0 and rng.random() < (self.density if facing else 0.3):
            side = facing[0] if facing else 0
            front = rng.uniform(0.0, 3.0) if facing else 1.0
            gap = rng.choice([0.02, rng.uniform(0.4, 1.6)])
            place, width = self.site.side(lot, side)
            _, depth = self.site.side(lot, side + 1)
            deep = min(depth - front - 0.2, rng.uniform(7.0, 14.0))
            objects.building(place.moved(gap, front, self.foot), width - 2 * gap, deep)
            if front > 1.4 and rng.random() < 0.5:
                objects.hedge(place.moved(0.0, up=KERB - 0.05), 0.6 * width)
            return
        for side in facing:
            place, width = self.site.side(lot, side)
            if rng.random() < 0.6:
                objects.hedge(place.moved(0.0, up=KERB - 0.05), width * rng.uniform(0.5, 1.0))
        for _ in range(rng.poisson(3.0 * self.greenery)):
            x, y = rng.uniform(x0 + 1.5, x1 - 1.5), rng.uniform(y0 + 1.5, y1 - 1.5)
            objects.tree(self.site.moved(x, y), rng.uniform(4.0, 10.0))

    def backdrop(self) -> None:
        """Trees and houses beyond the edge of town, so that no street ends in the sky."""
        rng, xs, ys = self.rng, self.plan.xs, self.plan.ys
        for number in range(4):
            edge, length = self.site.side((xs[0], ys[0], xs[-1], ys[-1]), number)
            for along in np.arange(0.0, length, 9.0).tolist():
                spot = edge.moved(along + rng.uniform(-3, 3), -rng.uniform(6.0, 25.0))
                if rng.random() < (1.0 if self.open else 0.7):
                    objects.tree(spot, rng.uniform(6.0, 13.0))
                else:
                    house = spot.moved(0.0, up=-0.3, turn=np.pi)
                    objects.building(house, rng.uniform(8, 14), rng.uniform(7, 11))
