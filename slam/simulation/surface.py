"""Surfaces that rays meet, cast with Open3D."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.runtime.imports import import_open3d
from slam.simulation.geometry import Float32Array, FloatArray, Mesh


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
