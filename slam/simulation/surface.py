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
        open3d = import_open3d()
        scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(open3d.core.Tensor(mesh.vertices), open3d.core.Tensor(mesh.triangles))
        return cls(mesh, scene)

    def cast(self, rays: Float32Array) -> dict[str, NDArray[Any]]:
        """Where rays ``(N, 6)`` meet it: ``t_hit`` (infinite if nowhere), triangle and barycentric weights."""
        answer = self.scene.cast_rays(import_open3d().core.Tensor(rays))
        return {name: answer[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_uvs")}


def place_rays(T_street_sensor: FloatArray, directions: Float32Array) -> Float32Array:
    """Origin and direction in the street frame of directions ``(N, 3)`` in a sensor's, ``(N, 6)``."""
    rays = np.empty((len(directions), 6), dtype=np.float32)
    rays[:, :3] = T_street_sensor[:3, 3]
    rays[:, 3:] = directions @ T_street_sensor[:3, :3].T.astype(np.float32)
    return rays
