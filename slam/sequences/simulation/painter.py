"""Turns ray hits into colour: gathers what was hit, shades each material, lights it, adds the haze."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.sequences.simulation.geometry import Float32Array, Material, Mesh
from slam.sequences.simulation.light import Weather, light
from slam.sequences.simulation.noise import Texels
from slam.sequences.simulation.optics import footprint
from slam.sequences.simulation.texture import shade


@dataclass(frozen=True)
class Hits:
    """Rays that met a mesh.

    Attributes:
        triangle: which, ``(N,)``.
        barycentric: weights of its second and third corner, ``(N, 2)``.
        rays: unit directions in the mesh's frame, ``(N, 3)``.
        depth: z-depth, metres, ``(N,)``.
        distance: along the ray, metres, ``(N,)``.
    """

    triangle: NDArray[np.int64]
    barycentric: Float32Array
    rays: Float32Array
    depth: Float32Array
    distance: Float32Array


def facing_normals(mesh: Mesh, hits: Hits) -> Float32Array:
    """Unit normals turned towards the viewer, ``(N, 3)``."""
    normals = mesh.normals[hits.triangle]
    towards = np.einsum("ij,ij->i", normals, hits.rays)
    return normals * np.where(towards > 0.0, np.float32(-1.0), np.float32(1.0))[:, None]


def paint(
    mesh: Mesh, hits: Hits, normals: Float32Array, lit: Float32Array, weather: Weather, focal_px: float
) -> Float32Array:
    """Colour of each hit, linear, ``(N, 3)``.

    Args:
        mesh: what was hit.
        hits: where.
        normals: from :func:`facing_normals`.
        lit: 1 where the sun is seen, ``(N,)``.
        weather: of the world.
        focal_px: focal length in pixels.
    """
    triangle, instance = hits.triangle, mesh.instance[hits.triangle]
    u_size, v_size = footprint(hits.depth / np.float32(focal_px), hits.rays, normals, mesh.tangents[triangle])
    corners = mesh.uv[triangle]  # (N, 3, 2)
    b1, b2 = hits.barycentric[:, :1], hits.barycentric[:, 1:]
    uv = corners[:, 0] * (1.0 - b1 - b2) + corners[:, 1] * b1 + corners[:, 2] * b2
    material = mesh.material[instance]
    rgb = np.empty((len(triangle), 3), dtype=np.float32)
    for kind in np.flatnonzero(np.bincount(material, minlength=len(Material))):
        chosen = np.flatnonzero(material == kind)
        look = instance[chosen]
        offsets = mesh.offsets[look]
        texels = Texels(
            uv[chosen, 0], uv[chosen, 1], u_size[chosen], v_size[chosen], offsets[:, 0], offsets[:, 1]
        )
        rgb[chosen] = shade(Material(kind), texels, mesh.colours[look], mesh.parameters[look])
    rgb *= light(weather, normals, lit)
    haze = -np.expm1(-hits.distance / np.float32(weather.visibility_m))
    return np.asarray(rgb + haze[:, None] * (weather.horizon - rgb), dtype=np.float32)
