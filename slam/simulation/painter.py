"""Shading of ray hits: texture of each material, light and haze."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.simulation.geometry import Float32Array, Material, Mesh
from slam.simulation.light import Weather, light
from slam.simulation.noise import Texels
from slam.simulation.optics import footprint
from slam.simulation.texture import shade


@dataclass(frozen=True)
class Hits:
    """Rays that met a mesh, sorted by material.

    Attributes:
        triangle: which, ``(N,)``.
        barycentric: weights of its second and third corner, ``(2, N)``.
        rays: unit directions in the mesh's frame, ``(3, N)``.
        normals: unit, turned towards the viewer, ``(3, N)``.
        depth: z-depth, metres, ``(N,)``.
        distance: along the ray, metres, ``(N,)``.
    """

    triangle: NDArray[np.int64]
    barycentric: Float32Array
    rays: Float32Array
    normals: Float32Array
    depth: Float32Array
    distance: Float32Array


def facing_normals(mesh: Mesh, triangle: NDArray[np.int64], rays: Float32Array) -> Float32Array:
    """Unit normals of triangles ``(N,)`` turned against rays ``(3, N)``, ``(3, N)``."""
    normals = np.take(mesh.normals, triangle, axis=1)
    return np.asarray(normals * -np.sign((normals * rays).sum(axis=0)))


def paint(mesh: Mesh, hits: Hits, lit: Float32Array, weather: Weather, focal_px: float) -> Float32Array:
    """Colour of each hit in the open, ``(3, N)``.

    Args:
        mesh: what was hit.
        hits: where, sorted by material.
        lit: 1 where the sun is seen, ``(N,)``.
        weather: of the world.
        focal_px: focal length in pixels.
    """
    rgb = unlit(mesh, hits, focal_px)
    if weather.contrast != 1.0:
        base = np.take(mesh.colours[0], np.take(mesh.instance, hits.triangle), axis=1)
        rgb *= np.clip(1.15 * rgb / base, 0.2, 2.0) ** np.float32(weather.contrast - 1.0)
    rgb *= light(weather, hits.normals, lit)
    haze = -np.expm1(-hits.distance / np.float32(weather.visibility_m))
    return np.asarray(rgb + haze * (weather.horizon[:, None] - rgb), dtype=np.float32)


def unlit(mesh: Mesh, hits: Hits, focal_px: float) -> Float32Array:
    """Colour of each hit under white light, ``(3, N)``; arguments as in `paint`."""
    tangents = np.take(mesh.tangents, hits.triangle, axis=1)
    u_size, v_size = footprint(hits.depth / np.float32(focal_px), hits.rays, hits.normals, tangents)
    corners = np.take(mesh.uv, hits.triangle, axis=2)  # (3, 2, N)
    b1, b2 = hits.barycentric
    u, v = corners[0] + b1 * (corners[1] - corners[0]) + b2 * (corners[2] - corners[0])
    instance = np.take(mesh.instance, hits.triangle)
    offsets = np.take(mesh.offsets, instance, axis=1)
    counts = np.bincount(np.take(mesh.material, hits.triangle), minlength=len(Material))
    ends = np.cumsum(counts)
    rgb = np.empty((3, len(hits.triangle)), dtype=np.float32)
    for kind in np.flatnonzero(counts):
        part = slice(int(ends[kind] - counts[kind]), int(ends[kind]))
        texels = Texels(u[part], v[part], u_size[part], v_size[part], offsets[0, part], offsets[1, part])
        colours = np.take(mesh.colours, instance[part], axis=2)
        parameters = np.take(mesh.parameters, instance[part], axis=1)
        rgb[:, part] = shade(Material(kind), texels, colours, parameters)
    return rgb
