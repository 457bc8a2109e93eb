"""Surfaces that rays meet, cast with Open3D, and their colour where they are met."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.runtime.imports import import_open3d
from slam.simulation.geometry import Float32Array, FloatArray, Material, Mesh
from slam.simulation.sensors import footprint
from slam.simulation.texture import SHADERS, Texels


@dataclass(frozen=True)
class Surface:
    """A mesh and its ray casting scene."""

    mesh: Mesh
    scene: Any

    @classmethod
    def of(cls, mesh: Mesh) -> "Surface":
        """The surface of a mesh."""
        return cls(mesh, scene_of(mesh.vertices, mesh.triangles))

    def cast(self, rays: Float32Array) -> dict[str, NDArray[Any]]:
        """Where rays ``(N, 6)`` meet it: ``t_hit`` (infinite if nowhere), triangle and barycentric weights."""
        answer = self.scene.cast_rays(import_open3d().core.Tensor(rays))
        return {name: answer[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_uvs")}


def scene_of(vertices: Float32Array, triangles: NDArray[np.uint32]) -> Any:
    """Open3D's scene of triangles ``(T, 3)`` between vertices ``(V, 3)``."""
    open3d = import_open3d()
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(triangles))
    return scene


def distances(scene: Any, points: FloatArray) -> FloatArray:
    """Distance from points ``(M, 3)`` to the nearest surface of a scene, ``(M,)``."""
    tensor = import_open3d().core.Tensor(points.astype(np.float32))
    return np.asarray(scene.compute_distance(tensor).numpy(), dtype=np.float64)


def place_rays(T_scene_sensor: FloatArray, directions: Float32Array) -> Float32Array:
    """Origin and direction in the scene of directions ``(N, 3)`` in a sensor's frame, ``(N, 6)``.

    Of several poses ``(H, 4, 4)`` each is that of an equal share of the directions in turn, as of the rows of an image.
    """
    rays = np.empty((len(directions), 6), dtype=np.float32)
    if T_scene_sensor.ndim == 3:
        by_row = directions.reshape(len(T_scene_sensor), -1, 3)
        rays[:, :3] = np.repeat(T_scene_sensor[:, :3, 3], by_row.shape[1], axis=0)
        rays[:, 3:] = (by_row @ T_scene_sensor[:, :3, :3].swapaxes(1, 2).astype(np.float32)).reshape(-1, 3)
        return rays
    rays[:, :3] = T_scene_sensor[:3, 3]
    rays[:, 3:] = directions @ T_scene_sensor[:3, :3].T.astype(np.float32)
    return rays


@dataclass(frozen=True)
class Hits:
    """Rays that met a mesh, sorted by material."""

    triangle: NDArray[np.int64]  # which, (N,)
    barycentric: Float32Array  # weights of its second and third corner, (2, N)
    rays: Float32Array  # unit directions in the mesh's frame, (3, N)
    normals: Float32Array  # unit, turned towards the viewer, (3, N)
    depth: Float32Array  # z-depth, metres, (N,)
    distance: Float32Array  # along the ray, metres, (N,)


def facing_normals(mesh: Mesh, triangle: NDArray[np.int64], rays: Float32Array) -> Float32Array:
    """Unit normals of triangles ``(N,)`` turned against rays ``(3, N)``, ``(3, N)``."""
    normals = np.take(mesh.normals, triangle, axis=1)
    return np.asarray(normals * -np.sign((normals * rays).sum(axis=0)))


def unlit(mesh: Mesh, hits: Hits, focal_px: float) -> Float32Array:
    """Colour of each hit under white light, ``(3, N)`` at a focal length in pixels."""
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
        rgb[:, part] = SHADERS[Material(kind)](texels, colours, parameters)
    return rgb
