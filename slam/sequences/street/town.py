"""A town along a street plan: carriageways, kerbs, pavements, house fronts, gardens and a skyline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.sequences.street.furniture import KERB_HEIGHT, UP, building, car, fine_quad, hsv, pole, tree
from slam.sequences.street.geometry import Bend, FloatArray, Material, Mesh, Soup
from slam.sequences.street.streets import StreetPlan

EAST, NORTH = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
OUTSKIRTS = 60.0  # of grass around the outermost streets, metres


@dataclass(frozen=True)
class _Side:
    """One street-facing side of a block: where it starts, which way it runs and which way is inwards."""

    corner: FloatArray
    along: FloatArray
    inward: FloatArray
    length: float
    depth: float  # to the middle of the block

    def at(self, x: float, inwards: float) -> FloatArray:
        return self.corner + self.along * x + self.inward * inwards


def build_town(plan: StreetPlan, bend: Bend, rng: np.random.Generator) -> Mesh:
    """Everything that does not move, as one mesh.

    Args:
        plan: where streets are.
        bend: from plan to street coordinates.
        rng: decides every look.
    """
    soup = Soup(rng)
    palette, density = float(rng.uniform(0, 1)), float(rng.uniform(0.6, 0.95))
    _lay_carriageways(soup, plan, rng)
    kerb = soup.instance(Material.KERB, np.array([0.62, 0.62, 0.6]))
    for i in range(len(plan.xs) - 1):
        for j in range(len(plan.ys) - 1):
            for side in _lay_block(soup, plan, rng, i, j):
                _furnish(soup, rng, side, palette + rng.normal(0, 0.04), density, kerb)
            _fill_lot(soup, plan, rng, i, j, palette)
    _raise_skyline(soup, plan, rng, palette)
    return soup.finish(bend)


def _lay_carriageways(soup: Soup, plan: StreetPlan, rng: np.random.Generator) -> None:
    """Asphalt with or without marks on every street, plain asphalt where streets meet."""
    half, grey = plan.half_width, np.array([0.34, 0.34, 0.35])
    kinds = [
        soup.instance(
            Material.ASPHALT,
            grey * rng.uniform(0.7, 1.25),
            None,
            (half, rng.uniform(2, 5), rng.uniform(0, 1), rng.uniform(0, 1)),
        )
        for _ in range(6)
    ]
    junction = soup.instance(Material.JUNCTION, grey * rng.uniform(0.8, 1.2))
    for i, x in enumerate(plan.xs):
        for j, y in enumerate(plan.ys):
            here = np.array([x, y, 0.0])
            fine_quad(soup, here - half * (EAST + NORTH), 2 * half * EAST, 2 * half * NORTH, junction, 4.0)
            if i + 1 < len(plan.xs) and plan.along_x[i, j]:
                reach = plan.xs[i + 1] - x - 2 * half
                corner = here + half * (EAST - NORTH)
                fine_quad(soup, corner, reach * EAST, 2 * half * NORTH, kinds[rng.integers(6)], 4.0)
            if j + 1 < len(plan.ys) and plan.along_y[i, j]:
                reach = plan.ys[j + 1] - y - 2 * half
                corner = here + half * (EAST + NORTH)
                fine_quad(soup, corner, reach * NORTH, -2 * half * EAST, kinds[rng.integers(6)], 4.0)


def _lay_block(soup: Soup, plan: StreetPlan, rng: np.random.Generator, i: int, j: int) -> list[_Side]:
    """The ground between four grid lines; its sides that face a street."""
    half = plan.half_width
    south, north = plan.along_x[i, j], plan.along_x[i, j + 1]
    west, east = plan.along_y[i, j], plan.along_y[i + 1, j]
    x0, x1, y0, y1 = plan.xs[i] + half, plan.xs[i + 1] - half, plan.ys[j] + half, plan.ys[j + 1] - half
    left, right = (x0 if west else plan.xs[i]), (x1 if east else plan.xs[i + 1])
    low, high = (y0 if south else plan.ys[j]), (y1 if north else plan.ys[j + 1])
    material = Material.GRASS if rng.random() < 0.7 else Material.GRAVEL
    lawn = soup.instance(material, hsv(rng.uniform(0.1, 0.3), rng.uniform(0.2, 0.5), rng.uniform(0.3, 0.5)))
    corner = np.array([left, low, KERB_HEIGHT - 0.01])
    fine_quad(soup, corner, (right - left) * EAST, (high - low) * NORTH, lawn)
    width, height = x1 - x0, y1 - y0
    depth = min(width, height) / 2
    sides = [
        (south, _Side(np.array([x0, y0, 0.0]), EAST, NORTH, width, depth)),
        (north, _Side(np.array([x1, y1, 0.0]), -EAST, -NORTH, width, depth)),
        (west, _Side(np.array([x0, y1, 0.0]), -NORTH, EAST, height, depth)),
        (east, _Side(np.array([x1, y0, 0.0]), NORTH, -EAST, height, depth)),
    ]
    return [side for is_street, side in sides if is_street and side.length > 3]


def _furnish(soup: Soup, rng: np.random.Generator, side: _Side, palette: float, density: float, kerb: int) -> None:
    """Kerb, pavement, houses or gardens, what stands on the pavement, and parked cars."""
    pavement = rng.uniform(1.6, 2.4)
    stone = np.array([0.55, 0.54, 0.52]) * rng.uniform(0.8, 1.2)
    slabs = soup.instance(Material.PAVEMENT, stone, None, (rng.uniform(0.3, 0.8),))
    fine_quad(soup, side.corner, side.along * side.length, UP * KERB_HEIGHT, kerb)
    fine_quad(soup, side.corner + UP * KERB_HEIGHT, side.along * side.length, side.inward * pavement, slabs)
    _build_front(soup, rng, side, pavement, palette, density)
    x = rng.uniform(1, 8)
    while x < side.length - 1:
        if rng.random() < 0.55:
            tree(soup, rng, side.at(x, rng.uniform(0.5, 1.0)), KERB_HEIGHT)
        elif rng.random() < 0.7:
            pole(soup, rng, side.at(x, rng.uniform(0.3, 0.6)), KERB_HEIGHT)
        x += rng.uniform(5, 14)
    x = rng.uniform(6, 12)
    while x < side.length - 7:
        if rng.random() < 0.5:
            heading = np.arctan2(side.along[1], side.along[0]) + rng.choice([0.0, np.pi]) + rng.normal(0, 0.03)
            car(soup, rng, side.at(x, -1.05), float(heading))
            x += 5
        x += rng.uniform(0.8, 9)


def _build_front(
    soup: Soup, rng: np.random.Generator, side: _Side, pavement: float, palette: float, density: float
) -> None:
    """Houses side by side, with gaps of hedge or fence and garden trees."""
    x = rng.uniform(0, 2)
    while x < side.length - 5:
        width = min(rng.uniform(6, 15), side.length - x)
        setback = pavement + rng.uniform(0.2, 2.5)
        depth = min(rng.uniform(6, 10), side.depth - setback - 0.5)
        if rng.random() < density and width > 4.5 and depth > 3:
            size = (width, depth, rng.uniform(4, 13))
            building(soup, rng, side.at(x, setback), side.along, side.inward, size, palette)
            x += width + (0 if rng.random() < 0.35 else rng.uniform(0.8, 5))
            continue
        if rng.random() < 0.6:
            material = Material.FENCE if rng.random() < 0.5 else Material.LEAVES
            tint = hsv(rng.uniform(0.05, 0.35), rng.uniform(0.2, 0.6), rng.uniform(0.25, 0.6))
            fence = soup.instance(material, tint, None, (rng.uniform(0.1, 0.25),))
            corner = side.at(x, pavement + 0.3)
            fine_quad(soup, corner, side.along * width, UP * rng.uniform(0.8, 1.7), fence, 3.0)
        for _ in range(int(rng.integers(1, 3))):
            behind = pavement + rng.uniform(1.8, 5)
            if behind < side.depth:
                tree(soup, rng, side.at(x + rng.uniform(0, width), behind), KERB_HEIGHT)
        x += width


def _fill_lot(soup: Soup, plan: StreetPlan, rng: np.random.Generator, i: int, j: int, palette: float) -> None:
    """Houses and trees away from the streets."""
    half = plan.half_width
    for _ in range(int(rng.integers(0, 3))):
        x = rng.uniform(plan.xs[i] + half + 3, plan.xs[i + 1] - half - 3)
        y = rng.uniform(plan.ys[j] + half + 3, plan.ys[j + 1] - half - 3)
        to_street = min(
            x - plan.xs[i] if plan.along_y[i, j] else np.inf,
            plan.xs[i + 1] - x if plan.along_y[i + 1, j] else np.inf,
            y - plan.ys[j] if plan.along_x[i, j] else np.inf,
            plan.ys[j + 1] - y if plan.along_x[i, j + 1] else np.inf,
        )
        place = np.array([x, y, 0.0])
        if to_street > half + 15:
            size = (rng.uniform(7, 12), rng.uniform(6, 9), rng.uniform(4, 10))
            building(soup, rng, place - 5 * EAST - 4 * NORTH, EAST, NORTH, size, palette)
        elif to_street > half + 5:
            tree(soup, rng, place, KERB_HEIGHT)


def _raise_skyline(soup: Soup, plan: StreetPlan, rng: np.random.Generator, palette: float) -> None:
    """Houses and groups of trees around the town, on grass."""
    low, high = np.array([plan.xs[0], plan.ys[0]]), np.array([plan.xs[-1], plan.ys[-1]])
    centre, reach = (low + high) / 2, (high - low) / 2 + 8
    count = int(4 * reach.sum() / 13)
    for k in range(count):
        turn = (k + rng.uniform(0, 1)) / count * 4
        across, out = (turn % 1) * 2 - 1, rng.uniform(0, 35)
        edge = int(turn) % 4
        unit = np.array([[across, -1], [1, across], [-across, 1], [-1, -across]][edge])
        away = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]][edge]) * out
        place = np.array([*(centre + unit * reach + away), 0.0])
        if rng.random() < 0.55:
            size = (rng.uniform(8, 16), rng.uniform(8, 12), rng.uniform(5, 17))
            building(soup, rng, place - 6 * EAST - 5 * NORTH, EAST, NORTH, size, palette)
        else:
            for _ in range(3):
                tree(soup, rng, place + np.array([*rng.normal(0, 4, 2), 0.0]), 0.0)
    meadow = soup.instance(Material.GRASS, hsv(0.2, 0.4, 0.35))
    corner = np.array([*(low - OUTSKIRTS), -0.05])
    span = high - low + 2 * OUTSKIRTS
    fine_quad(soup, corner, span[0] * EAST, span[1] * NORTH, meadow, 10.0)
