"""Triangle meshes with materials: grids of quads, bent onto the terrain or moved as a whole."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]

PARAMETERS = 6  # of a texture
# fields of a mesh whose last axis is that of its triangles
_OF_TRIANGLES = ("uv", "normals", "tangents", "instance", "material")

Material = IntEnum(  # of a surface; selects its texture
    "Material",
    "ASPHALT JUNCTION PAVEMENT KERB GRASS GRAVEL WALL ROOF BARK LEAVES METAL SIGN PAINT GLASS "
    "TYRE FENCE PLASTER TILES BOARDS CARPET WOOD FABRIC BOOKS PICTURE SCREEN PANE CARTON LAMP",
    start=0,
)


@dataclass(frozen=True)
class Mesh:
    """A finished mesh in the street frame (x east, y north, z up, metres).

    Triangles and instances are the last axis of the lookup tables, for which gathering is several
    times faster.
    """

    vertices: Float32Array  # (V, 3)
    triangles: NDArray[np.uint32]  # vertex indices, (T, 3)
    uv: Float32Array  # texture coordinates of the three corners, metres, (3, 2, T)
    normals: Float32Array  # unit normals, (3, T)
    tangents: Float32Array  # unit direction in which u grows, (3, T)
    instance: NDArray[np.int32]  # index into the tables below, (T,)
    material: NDArray[np.int8]  # of each triangle, (T,)
    colours: Float32Array  # two base colours per instance, RGB in [0, 1], (2, 3, I)
    parameters: Float32Array  # of the material's texture, (PARAMETERS, I)
    offsets: Float32Array  # of an instance in the noise texture, (2, I)


@functools.lru_cache(maxsize=256)
def _patch_triangles(rows: int, columns: int) -> IntArray:
    """Triangles of a grid of vertices, wound so that (column, row) is right-handed, ``(T, 3)``."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (
        part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
    )
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


class Soup:
    """Collects patches, then bends all of them onto the terrain."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        # vertices, triangles, their texture coordinates and instances, patch by patch
        self._patches: list[tuple[FloatArray, IntArray, FloatArray, IntArray]] = []
        # material, colours and parameters, by instance
        self._looks: list[tuple[int, FloatArray, FloatArray]] = []
        self._count = 0  # of vertices

    @property
    def instances(self) -> int:
        """Number of registered instances."""
        return len(self._looks)

    def instance(
        self,
        material: Material,
        colour: FloatArray,
        colour2: FloatArray | None = None,
        parameters: tuple[float, ...] = (),
    ) -> int:
        """Register an instance with its colours and parameters; return its number."""
        row = np.zeros(PARAMETERS)
        row[: len(parameters)] = parameters
        self._looks.append(
            (int(material), np.stack([colour, colour if colour2 is None else colour2]), row)
        )
        return len(self._looks) - 1

    def patch(self, points: FloatArray, uv: FloatArray, instance: int) -> None:
        """Add a grid of quads.

        Args:
            points: its vertices in the plan, ``(R, C, 3)``.
            uv: texture coordinates of the vertices, metres, ``(R, C, 2)``.
            instance: its look, a number from `instance`.
        """
        triangles = _patch_triangles(points.shape[0], points.shape[1])
        of_triangles = (
            triangles + self._count,
            uv.reshape(-1, 2)[triangles],
            np.full(len(triangles), instance),
        )
        self._patches.append((points.reshape(-1, 3), *of_triangles))
        self._count += points.shape[0] * points.shape[1]

    def quad(self, corner: FloatArray, along: FloatArray, up: FloatArray, instance: int) -> None:
        """Add one parallelogram, textured in metres from its corner."""
        points = np.stack([[corner, corner + along], [corner + up, corner + along + up]])
        width, height = float(np.linalg.norm(along)), float(np.linalg.norm(up))
        self.patch(
            points, np.array([[[0, 0], [width, 0]], [[0, height], [width, height]]]), instance
        )

    def finish(self, bend: "Bend") -> Mesh:
        """Bend every vertex from plan to street coordinates and drop triangles without area."""
        vertices, triangles, uv, instance = map(np.concatenate, zip(*self._patches))
        vertices = bend(vertices)
        materials, colours, parameters = (np.array(table) for table in zip(*self._looks))
        corners = vertices[triangles]  # (T, 3, 3)
        edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        normals = np.cross(edge1, edge2)
        area = np.linalg.norm(normals, axis=1)
        keep = area > 1e-6
        uv1, uv2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
        determinant = uv1[:, 0] * uv2[:, 1] - uv2[:, 0] * uv1[:, 1]
        tangents = (edge1 * uv2[:, 1:] - edge2 * uv1[:, 1:]) * np.sign(determinant)[:, None]
        tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
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
            offsets=_last(self._rng.uniform(0.0, 200.0, (self.instances, 2))),
        )


def _last(table: FloatArray) -> Float32Array:
    """A table with its first axis moved to the end, contiguous."""
    return np.ascontiguousarray(np.moveaxis(table, 0, -1), dtype=np.float32)


@dataclass(frozen=True)
class Bend:
    """A smooth map from the plan (straight streets, flat ground) to the street frame.

    Streets of a town are swayed by two slow sine waves; a lone road follows a heading that wanders.
    """

    amplitudes: FloatArray  # of the sway in x and in y and of the hills, metres, (3,)
    wavelengths: FloatArray  # of the same, metres, (3,)
    phases: FloatArray  # of the same, radians, (3, 2)
    # x, y and heading of a lone road every metre from road_start on, (M, 3)
    road: FloatArray | None = None
    road_start: float = 0.0  # plan x of its first row

    def __call__(self, points: FloatArray) -> FloatArray:
        """Map plan points ``(..., 3)`` to the street frame."""
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        k = 2.0 * np.pi / self.wavelengths
        hill = (
            self.amplitudes[2]
            * np.sin(k[2] * x + self.phases[2, 0])
            * np.cos(k[2] * y + self.phases[2, 1])
        )
        if self.road is None:
            sway_x = self.amplitudes[0] * np.sin(k[0] * y + self.phases[0, 0])
            sway_y = self.amplitudes[1] * np.sin(k[1] * x + self.phases[1, 0])
            return np.stack([x + sway_x, y + sway_y, z + hill], axis=-1)
        steps = np.arange(len(self.road)) + self.road_start
        centre_x, centre_y, heading = (np.interp(x, steps, self.road[:, i]) for i in range(3))
        return np.stack(
            [centre_x - y * np.sin(heading), centre_y + y * np.cos(heading), z + hill], axis=-1
        )


FLAT = Bend(np.zeros(3), np.ones(3), np.zeros((3, 2)))  # the plan as it is


def town_bend(rng: np.random.Generator, hills: tuple[float, float] | None = None) -> Bend:
    """Streets that sway by a few degrees over hills.

    The hills are gentle, or of a steepness (rise over run) and a wavelength in metres.
    """
    wavelengths = rng.uniform([120.0, 120.0, 140.0], [220.0, 220.0, 220.0])
    amplitudes = np.array([*rng.uniform(0.5, 2.2, 2), rng.uniform(0.1, 0.45)])
    phases = rng.uniform(0.0, 2.0 * np.pi, (3, 2))
    if hills is not None:
        wavelengths[2] = hills[1]
        amplitudes[2] = hills[0] * hills[1] / (2.0 * np.pi)
        # across the road at y = 0 it is at most a third as steep as along it
        phases[2, 1] = rng.uniform(-0.35, 0.35)
    return Bend(amplitudes, wavelengths, phases)


def road_bend(
    rng: np.random.Generator, start: float, end: float, hills: tuple[float, float] | None = None
) -> Bend:
    """A road whose heading wanders within about 35 degrees, at a radius of about 80 m or more."""
    town = town_bend(rng, hills)
    s = np.arange(np.floor(start), np.ceil(end) + 2.0)
    heading = np.zeros_like(s)
    for wavelength, amplitude in (
        (rng.uniform(330.0, 480.0), 0.38),
        (rng.uniform(150.0, 220.0), 0.14),
    ):
        heading += (
            rng.uniform(0.5, 1.0)
            * amplitude
            * np.sin(2 * np.pi * s / wavelength + rng.uniform(0, 6.28))
        )
    position = np.cumsum(np.stack([np.cos(heading), np.sin(heading)], 1), axis=0)
    return Bend(
        town.amplitudes,
        town.wavelengths,
        town.phases,
        np.column_stack([position, heading]),
        float(s[0]),
    )


class Moving:
    """Meshes around their own origins, to be placed anew at every frame."""

    def __init__(self, rng: np.random.Generator, makers: Sequence[Callable[[Soup], None]]) -> None:
        """Things that are made one after another in one soup."""
        soup, first_instances = Soup(rng), []
        for make in makers:
            first_instances.append(soup.instances)
            make(soup)
        self._mesh = soup.finish(FLAT)
        self._thing_of_triangle = (
            np.searchsorted(first_instances, self._mesh.instance, side="right") - 1
        )

    def placed(self, T_scene_things: dict[int, FloatArray]) -> list[Mesh]:
        """One mesh of the things of these numbers at their poses ``(4, 4)``; none of no things."""
        if not T_scene_things:
            return []
        parts = [
            self._part(number, T_scene_thing) for number, T_scene_thing in T_scene_things.items()
        ]
        corners = np.concatenate([part.vertices for part in parts])
        corners_of = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
        tables = {}
        for name in _OF_TRIANGLES:
            tables[name] = np.concatenate([getattr(part, name) for part in parts], axis=-1)
        return [dataclasses.replace(self._mesh, vertices=corners, triangles=corners_of, **tables)]

    def _part(self, number: int, T_scene_thing: FloatArray) -> Mesh:
        """The triangles of one thing, three vertices each, moved into the scene."""
        mine = self._thing_of_triangle == number
        R, t = T_scene_thing[:3, :3].astype(np.float32), T_scene_thing[:3, 3].astype(np.float32)
        tables = {name: getattr(self._mesh, name)[..., mine] for name in _OF_TRIANGLES}
        tables |= {name: R @ tables[name] for name in ("normals", "tangents")}
        vertices = self._mesh.vertices[self._mesh.triangles[mine].ravel()] @ R.T + t
        return dataclasses.replace(self._mesh, vertices=vertices, **tables)
