"""The light on the surfaces of a house: from its lamps and windows, and from other surfaces."""

import functools

import numpy as np

from slam.frames import Float32Array
from slam.geometry.se3 import FloatArray, IntArray
from slam.runtime.imports import import_open3d
from slam.simulation.geometry import luck, unit
from slam.simulation.interior import interior_of
from slam.simulation.room_textures import GLOWING
from slam.simulation.world import MATERIALS, Surface

_RAYS = 48  # around a corner
_BOUNCES = 3
_ALBEDO = 0.55
_REACH_M = 9.0  # of a lamp
# of each material
GLOW = np.array([GLOWING.get(material, 0.0) for material in MATERIALS], dtype=np.float32)


@functools.lru_cache(maxsize=2)
def irradiance_of(seed: int, some_are_dim: bool) -> Float32Array:
    """Irradiance in a house, some rooms of which may be dim.

    It is that at the corners of triangles, about 1 below a lamp, ``(3, T)``; they face the side
    that is seen.
    """
    interior = interior_of(seed)
    lights = interior.lights.copy()
    if some_are_dim:
        strength = np.exp(luck(seed, 54).uniform(-1.5, 0.5, len(interior.rooms)))
        for room, factor in zip(interior.rooms, strength):
            lights[room.contains(lights[:, :2]), 3] *= factor
    surface, mesh = Surface(interior.mesh), interior.mesh
    triangles = mesh.triangles.astype(np.int64)
    count = len(mesh.vertices)
    middle, normal = np.zeros((2, count, 3))
    uses = np.bincount(triangles.ravel(), minlength=count)[:, None]
    for corner in triangles.T:
        np.add.at(middle, corner, mesh.vertices[triangles].mean(axis=1))
        np.add.at(normal, corner, mesh.normals.T)
    normal = unit(normal)
    middle /= np.maximum(uses, 1)
    # out of the corner, off the surface
    points = mesh.vertices + 0.12 * (middle - mesh.vertices) + 0.015 * normal
    direct = np.zeros(len(points))  # the light of the lamps that are seen
    for *lamp, strength in lights:
        towards = np.array(lamp) - points
        distance = np.linalg.norm(towards, axis=1)
        cosine = (towards * normal).sum(axis=1) / np.maximum(distance, 1e-9)
        near = np.flatnonzero((distance < _REACH_M) & (cosine > 0.0))
        rays = np.hstack([points[near], towards[near]]).astype(np.float32)
        blocked = surface.scene.test_occlusions(
            import_open3d().core.Tensor(rays), 0.0, 0.97
        ).numpy()
        fade = strength * cosine[near] / (1.0 + 0.35 * distance[near] ** 2)
        direct[near] += np.where(blocked, 0.0, fade)
    hit = _around(surface, points, normal)
    shining = GLOW[mesh.material] > 0.0
    total = direct
    for _ in range(_BOUNCES):
        thrown = np.where(shining, 1.2, _ALBEDO * total[triangles].mean(axis=1))
        thrown = np.append(thrown, 0.0)  # for rays that meet nothing
        total = direct + thrown[hit].mean(axis=0)
    return np.ascontiguousarray(total[triangles].T, dtype=np.float32)


def _around(surface: Surface, points: FloatArray, normals: FloatArray) -> IntArray:
    """Triangles that cosine-weighted rays from points ``(V, 3)`` meet, ``(_RAYS, V)``.

    It is -1 where a ray meets none.
    """
    height = 1.0 - 2.0 * (np.arange(_RAYS) + 0.5) / _RAYS
    turn, level = np.arange(_RAYS) * 2.39996, np.sqrt(1.0 - height * height)  # the golden angle
    sphere = np.stack([level * np.cos(turn), level * np.sin(turn), height], axis=1)
    found = np.empty((_RAYS, len(points)), dtype=np.int64)
    for k, away in enumerate(sphere):
        # a normal and a point of the unit sphere: as often along the cosine to the normal
        answer = surface.cast(np.hstack([points, normals + away]).astype(np.float32))
        met = np.isfinite(answer["t_hit"])
        found[k] = np.where(met, answer["primitive_ids"].astype(np.int64), -1)
    return found
