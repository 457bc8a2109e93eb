"""Things that move as wholes through a world: cars and people."""

import dataclasses

import numpy as np

from slam.simulation.geometry import FLAT, FloatArray, Mesh, Soup


class Moving:
    """Meshes around their own origins, to be placed anew at every frame."""

    def __init__(self, soup: Soup, first_instances: list[int]) -> None:
        """Things in a soup, each of which begins with one of these instances."""
        self._mesh = soup.finish(FLAT)
        self._thing_of_triangle = np.searchsorted(first_instances, self._mesh.instance, side="right") - 1

    def placed(self, T_scene_things: dict[int, FloatArray]) -> list[Mesh]:
        """One mesh of the things of these numbers at their poses ``(4, 4)``; none of no things."""
        if not T_scene_things:
            return []
        parts = [self._part(number, T_scene_thing) for number, T_scene_thing in T_scene_things.items()]
        corners = np.concatenate([part.vertices for part in parts])
        placed = dataclasses.replace(
            self._mesh,
            vertices=corners,
            triangles=np.arange(len(corners), dtype=np.uint32).reshape(-1, 3),
            uv=np.concatenate([part.uv for part in parts], axis=-1),
            normals=np.concatenate([part.normals for part in parts], axis=-1),
            tangents=np.concatenate([part.tangents for part in parts], axis=-1),
            instance=np.concatenate([part.instance for part in parts]),
            material=np.concatenate([part.material for part in parts]),
        )
        return [placed]

    def _part(self, number: int, T_scene_thing: FloatArray) -> Mesh:
        """The triangles of one thing, three vertices each, moved into the scene."""
        mine = self._thing_of_triangle == number
        R, t = T_scene_thing[:3, :3].astype(np.float32), T_scene_thing[:3, 3].astype(np.float32)
        return dataclasses.replace(
            self._mesh,
            vertices=self._mesh.vertices[self._mesh.triangles[mine].ravel()] @ R.T + t,
            uv=self._mesh.uv[..., mine],
            normals=R @ self._mesh.normals[:, mine],
            tangents=R @ self._mesh.tangents[:, mine],
            instance=self._mesh.instance[mine],
            material=self._mesh.material[mine],
        )
