"""Where surfaces are built: simple bodies and their looks, and level rectangles of a plan."""

import copy
import functools
from collections.abc import Callable, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from erfsfm.common.config_tree import parse_yaml
from erfsfm.common.files import read_text
from slam.frames import Float32Array
from slam.geometry.se3 import FloatArray, IntArray
from slam.simulation.geometry import FLAT, PARAMETERS, Bend, Mesh, unit
from slam.simulation.world import MATERIALS

Rectangle = tuple[float, float, float, float]  # x0, y0, x1, y1

UP = np.array([0.0, 0.0, 1.0])


@functools.cache
def _palettes() -> Any:
    """Spread and colours of each thing."""
    return parse_yaml(read_text(Path(__file__).with_name("colours.yaml")))


@functools.lru_cache(maxsize=256)
def _patch_triangles(rows: int, columns: int) -> IntArray:
    """Triangles of a grid of vertices, wound so that (column, row) is right-handed, ``(T, 3)``."""
    corner = np.arange(rows * columns).reshape(rows, columns)[:-1, :-1].reshape(-1, 1)
    opposite = corner + columns + 1
    halves = [corner, corner + 1, opposite], [corner, opposite, opposite - 1]
    return np.concatenate([np.hstack(half) for half in halves])


class Site:
    """A place to build at. All places of a world collect patches for one mesh.

    Attributes:
        rng: draws what is left open.
        frame: the place's x, y and z axis and its origin as rows, ``(4, 3)``.
        looks: material, colours and parameters of each instance so far.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        """A world without surfaces, at the origin of its plan."""
        self.rng, self.frame = rng, np.eye(4, 3)
        # vertices, triangles, their texture coordinates and instances, patch by patch
        self._patches: list[tuple[FloatArray, IntArray, FloatArray, IntArray]] = []
        self.looks: list[tuple[int, FloatArray, FloatArray]] = []

    @property
    def origin(self) -> FloatArray:
        """Where it is, ``(3,)``."""
        return self.frame[3]

    def moved(
        self, along: float, across: float = 0.0, up: float = 0.0, turn: float = 0.0
    ) -> "Site":
        """The place so far along its own axes, metres, turned by radians to the left."""
        c, s = np.cos(turn), np.sin(turn)
        axes, site = self.frame[:3], copy.copy(self)
        turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ axes
        site.frame = np.vstack([turned, self.origin + (along, across, up) @ axes])
        return site

    def side(self, rectangle: Rectangle, number: int) -> tuple["Site", float]:
        """Where a side of a rectangle begins, x along it and y inwards, and the side's length.

        Sides are numbered counterclockwise: 0 south, 1 east, 2 north, 3 west.
        """
        x0, y0, x1, y1 = rectangle
        x, y = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))[number % 4]
        length = y1 - y0 if number % 2 else x1 - x0
        return self.moved(x, y, turn=number * np.pi / 2.0), length

    def colour(self, thing: str) -> FloatArray:
        """One of the colours that a thing of ``colours.yaml`` may have, a little off, ``(3,)``."""
        spread, colours = itemgetter("spread", "colours")(_palettes()[thing])
        base = np.array(colours[self.rng.integers(len(colours))])
        off = self.rng.normal(0.0, spread) + self.rng.normal(0.0, 0.4 * spread, 3)
        return np.clip(base + off, 0.02, 1.0)

    def instance(
        self,
        material: str,
        colour: ArrayLike,
        second: ArrayLike = 1.0,
        parameters: tuple[float, ...] = (),
    ) -> int:
        """Register an instance with its colours and parameters; return its number.

        Args:
            material: one of `MATERIALS`, whose texture it has.
            colour: RGB in [0, 1], ``(3,)``, or the name of a thing whose `colour` is drawn.
            second: the same of the texture's second colour, or a share of the first.
            parameters: of the texture.
        """
        row = np.zeros(PARAMETERS)
        row[: len(parameters)] = parameters
        colour = self.colour(colour) if isinstance(colour, str) else np.array(colour)
        if isinstance(second, str):
            second = self.colour(second)
        elif isinstance(second, float):
            second = second * colour
        self.looks.append((MATERIALS.index(material), np.array([colour, second]), row))
        return len(self.looks) - 1

    def patch(self, points: FloatArray, uv: FloatArray, instance: int) -> None:
        """Add a grid of quads.

        Args:
            points: its vertices in the plan, ``(R, C, 3)``.
            uv: texture coordinates of the vertices, metres, ``(R, C, 2)``.
            instance: its look, a number from `instance`.
        """
        triangles = _patch_triangles(points.shape[0], points.shape[1])
        looks = np.full(len(triangles), instance)
        self._patches.append(
            (points.reshape(-1, 3), triangles, uv.reshape(-1, 2)[triangles], looks)
        )

    def quad(self, corner: FloatArray, along: FloatArray, up: FloatArray, instance: int) -> None:
        """Add one parallelogram, textured in metres from its corner."""
        points = np.stack([[corner, corner + along], [corner + up, corner + along + up]])
        width, height = (float(np.linalg.norm(side)) for side in (along, up))
        self.patch(points, lattice((0.0, width), (0.0, height)), instance)

    def box(
        self,
        size: tuple[float, ...],
        look: int,
        low: tuple[float, ...] = (0.0, 0.0, 0.0),
        top: int = -1,
    ) -> None:
        """Walls and a lid from the lowest corner at the place, and a floor where that is above it.

        Args:
            size: along the place's axes ``(3,)``.
            look: an instance.
            low: the lowest corner ``(3,)``.
            top: instance of the lid, if another.
        """
        x, y, z = np.array(size)[:, None] * self.frame[:3]
        corner = self.moved(*low).origin
        self.quad(corner, x, z, look)
        self.quad(corner + x, y, z, look)
        self.quad(corner + x + y, -x, z, look)
        self.quad(corner + y, -y, z, look)
        self.quad(corner + z, x, y, look if top < 0 else top)
        if low[2] > 0.0:
            self.quad(corner + y, x, -y, look)

    def plate(self, low: tuple[float, ...], size: tuple[float, ...], front: int, rest: int) -> None:
        """A box that shows ``front`` on the side that leaves the wall, a hair before the box."""
        self.box(size, rest, low)
        corner = self.moved(low[0] + size[0], low[1] + size[1] + 0.002, low[2]).origin
        self.quad(corner, -size[0] * self.frame[0], size[2] * self.frame[2], front)

    def tube(
        self, base: FloatArray, tip: FloatArray, radii: tuple[float, float], instance: int
    ) -> None:
        """Six-sided tapering tube from ``base`` to ``tip``, ``(3,)`` each."""
        height = float(np.linalg.norm(tip - base))
        axis = (tip - base) / height
        side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.7 else [0.0, 1.0, 0.0])
        side /= np.linalg.norm(side)
        other = np.cross(axis, side)
        angle = np.linspace(0.0, 2.0 * np.pi, 7)
        ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other  # (7, 3)
        points = np.stack([base + radii[0] * ring, tip + radii[1] * ring])
        self.patch(points, lattice(angle * radii[0], (0.0, height)), instance)

    def pole(self, height: float, radii: tuple[float, float], instance: int) -> FloatArray:
        """A `tube` that stands at the place; its tip ``(3,)``."""
        tip = self.origin + height * UP
        self.tube(self.origin, tip, radii, instance)
        return tip

    def ball(self, centre: FloatArray, radii: ArrayLike, instance: int) -> None:
        """A lumpy ellipsoid of 6 x 9 faces around a point ``(3,)``."""
        size = np.asarray(radii)
        around, polar = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 10), np.linspace(0.0, np.pi, 7))
        sin_polar = np.sin(polar)
        unit = np.stack(
            [sin_polar * np.cos(around), sin_polar * np.sin(around), np.cos(polar)], axis=2
        )
        lump = self.rng.uniform(0.75, 1.2, (7, 10, 1))
        lump[:, -1], lump[0], lump[-1] = lump[:, 0], 1.0, 1.0
        uv = np.stack([around * size[0], polar * size[2]], axis=2)
        self.patch(centre + unit * lump * size, uv, instance)

    def finish(self, bend: Bend) -> Mesh:
        """Bend every vertex from plan to street coordinates and drop triangles without area."""
        points, triangles_of, uv_of, instances = zip(*self._patches)
        first = np.cumsum([0, *map(len, points)])
        vertices = bend(np.concatenate(points))
        triangles = np.concatenate([mine + k for mine, k in zip(triangles_of, first)])
        uv, instance = np.concatenate(uv_of), np.concatenate(instances)
        materials, colours, parameters = map(np.array, zip(*self.looks))
        corners = vertices[triangles]  # (T, 3, 3)
        edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        normals = np.cross(edge1, edge2)
        area = np.linalg.norm(normals, axis=1)
        keep = area > 1e-6
        uv1, uv2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
        determinant = uv1[:, 0] * uv2[:, 1] - uv2[:, 0] * uv1[:, 1]
        tangents = (edge1 * uv2[:, 1:] - edge2 * uv1[:, 1:]) * np.sign(determinant)[:, None]
        tangents = unit(tangents)
        normals /= np.maximum(area, 1e-9)[:, None]
        return Mesh(
            vertices=vertices.astype(np.float32),
            triangles=triangles[keep].astype(np.uint32),
            uv=_last(uv[keep]),
            normals=_last(normals[keep]),
            tangents=_last(tangents[keep]),
            instance=instance[keep].astype(np.int32),
            material=materials.astype(np.int8)[instance[keep]],
            colours=_last(colours),
            parameters=_last(parameters),
            offsets=_last(self.rng.uniform(0.0, 200.0, (len(self.looks), 2))),
        )


def _last(table: FloatArray) -> Float32Array:
    """A table with its first axis moved to the end, contiguous."""
    return np.ascontiguousarray(np.moveaxis(table, 0, -1), dtype=np.float32)


def things(rng: np.random.Generator, makers: Sequence[Callable[[Site], None]]) -> list[Mesh]:
    """What each maker makes around its own origin; all draw from the same random numbers."""
    sites = [Site(rng) for _ in makers]
    for site, make in zip(sites, makers):
        make(site)
    return [site.finish(FLAT) for site in sites]


def lattice(u: ArrayLike, v: ArrayLike) -> FloatArray:
    """Coordinates of a grid ``(R, C, 2)`` by those of its columns ``(C,)`` and of its rows ``(R,)``."""
    return np.stack(np.meshgrid(u, v), axis=2)


def grid_over(rectangle: Rectangle, z: float, step: float) -> FloatArray:
    """Vertices over a rectangle about ``step`` metres apart, ``(R, C, 3)``."""
    x, y = (
        np.linspace(low, high, max(1, int((high - low) / step)) + 1)
        for low, high in (rectangle[::2], rectangle[1::2])
    )
    return np.insert(lattice(x, y), 2, z, axis=-1)
