"""Triangle meshes with materials, and the terrain that the streets of a plan are bent onto."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.frames import Float32Array
from slam.geometry import se3
from slam.geometry.se3 import FloatArray

PARAMETERS = 6  # of a texture


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
    material: NDArray[np.int8]  # of each triangle, a row of `world.MATERIALS`, (T,)
    colours: Float32Array  # two base colours per instance, RGB in [0, 1], (2, 3, I)
    parameters: Float32Array  # of the material's texture, (PARAMETERS, I)
    offsets: Float32Array  # of an instance in the noise texture, (2, I)

    def placed(self, T_scene_mesh: FloatArray) -> "Mesh":
        """The same at a pose ``(4, 4)``."""
        T = T_scene_mesh.astype(np.float32)
        turned = {name: T[:3, :3] @ getattr(self, name) for name in ("normals", "tangents")}
        return replace(self, vertices=self.vertices @ T[:3, :3].T + T[:3, 3], **turned)


@dataclass(frozen=True)
class Bend:
    """A smooth map from the plan (straight streets, flat ground) to the street frame.

    Streets of a town are swayed by two slow sine waves; a lone road follows a heading that wanders.
    """

    amplitudes: FloatArray  # of the sway in x and in y and of the hills, metres, (3,)
    wavelengths: FloatArray  # of the same, metres, (3,)
    phases: FloatArray  # of the same, radians, (3, 2)
    road: FloatArray | None = None  # plan x, and x, y and heading there, of a lone road, (M, 4)

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
        centre_x, centre_y, heading = se3.interpolated(x, self.road[:, 0], self.road[:, 1:]).T
        return np.stack(
            [centre_x - y * np.sin(heading), centre_y + y * np.cos(heading), z + hill], axis=-1
        )


FLAT = Bend(np.zeros(3), np.ones(3), np.zeros((3, 2)))  # the plan as it is


def town_bend(rng: np.random.Generator, hills: tuple[float, float] | None) -> Bend:
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
    rng: np.random.Generator, start: float, end: float, hills: tuple[float, float] | None
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
    return replace(town, road=np.column_stack([s, position, heading]))


def unit(rows: FloatArray) -> FloatArray:
    """Directions of vectors ``(N, 3)`` or ``(N, 2)``; those of no length stay as they are."""
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)


def luck(seed: int, *draw: int) -> np.random.Generator:
    """The random numbers of one draw of a world: others do not change with them."""
    return np.random.default_rng([seed, *draw])
