"""Surfaces that rays meet, cast with Open3D, and their colour where they are met.

In the open it is that under the sun, the sky and the haze of one street.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.runtime.imports import import_open3d
from slam.simulation.geometry import Float32Array, FloatArray, Material, Mesh
from slam.simulation.texture import SHADERS, Texels, fractal


class Surface:
    """A mesh and its ray casting scene."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh, self.scene = mesh, scene_of(mesh.vertices, mesh.triangles)

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


def _footprint(
    pixel: Float32Array, rays: Float32Array, normals: Float32Array, tangents: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Extent of a pixel on a surface along its u and v axes, grazing angle included.

    A round pixel of size f ``(N,)``, metres at the surface's distance, seen by rays at angle a to the normals is an
    ellipse of axes f and f / cos a; along a tangent t it extends f sqrt(1 + (ray . t)^2 / cos^2 a). All directions are
    unit, ``(3, N)``.
    """
    cosine = np.abs((rays * normals).sum(axis=0))
    along_u = (rays * tangents).sum(axis=0)
    cosine2 = np.maximum(cosine * cosine, 1e-4)
    u2 = along_u * along_u
    v2 = np.maximum(1.0 - cosine * cosine - u2, 0.0)
    return pixel * np.sqrt(1.0 + u2 / cosine2), pixel * np.sqrt(1.0 + v2 / cosine2)


def unlit(mesh: Mesh, hits: Hits, focal_px: float) -> Float32Array:
    """Colour of each hit under white light, ``(3, N)`` at a focal length in pixels."""
    tangents = np.take(mesh.tangents, hits.triangle, axis=1)
    u_size, v_size = _footprint(hits.depth / np.float32(focal_px), hits.rays, hits.normals, tangents)
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


@dataclass(frozen=True)
class Weather:
    """How a world is lit."""

    sun: Float32Array  # unit direction towards the sun, street frame, (3,)
    sunshine: float  # strength of the direct light, 0 overcast
    ambient: float  # strength of the light from everywhere
    zenith: Float32Array  # colour of the sky overhead, (3,)
    horizon: Float32Array  # colour of the sky low down, and of the haze, (3,)
    clouds: float  # cover, 0 to 1
    visibility_m: float  # distance at which the haze has taken 63 %
    exposure: float | None  # gain of the camera; None sets it so that a share of the pixels saturates
    saturated: float = 0.0  # that share
    contrast: float = 1.0  # of textures, an exponent; 1 as they are painted


def _draw_sun(rng: np.random.Generator, lowest: float, highest: float) -> FloatArray:
    """Its direction at an elevation in radians, ``(3,)``."""
    azimuth, elevation = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(lowest, highest)
    sun = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return np.array(sun)


def draw_weather(seed: int) -> Weather:
    """Weather of a world."""
    rng = np.random.default_rng([seed, 20])
    sun = _draw_sun(rng, 0.5, 1.1)
    sunshine = float(rng.uniform(0.25, 0.75))
    return Weather(
        sun=sun.astype(np.float32),
        sunshine=sunshine,
        ambient=0.95 - 0.6 * sunshine,
        zenith=(np.array([0.38, 0.56, 0.85]) + rng.uniform(-0.06, 0.06, 3)).astype(np.float32),
        horizon=(np.array([0.80, 0.84, 0.88]) + rng.uniform(-0.06, 0.06, 3)).astype(np.float32),
        clouds=float(rng.uniform(0.0, 1.0)),
        visibility_m=float(rng.uniform(220.0, 600.0)),
        exposure=float(rng.uniform(0.95, 1.2)),
    )


def draw_varied_weather(seed: int) -> Weather:
    """Weather of a varied world: three in four have a sun beside which shadows are 3 to 10 times as dark."""
    rng = np.random.default_rng([seed, 21])
    sun = _draw_sun(rng, 0.3, 1.15)
    sunny = rng.random() < 0.75
    ambient = 1.0 / float(np.exp(rng.uniform(np.log(3.0), np.log(10.0)))) if sunny else float(rng.uniform(0.6, 0.95))
    bright = float(rng.uniform(0.6, 1.3) if sunny else rng.uniform(0.9, 1.4))
    blue = np.array([0.30, 0.52, 0.85]) + rng.uniform(-0.08, 0.08, 3)
    return Weather(
        sun=sun.astype(np.float32),
        sunshine=(1.0 - ambient) / sun[2],  # a level road has 1 in the sun
        ambient=ambient,
        zenith=(bright * blue).astype(np.float32),
        horizon=(bright * (np.array([0.80, 0.86, 0.92]) + rng.uniform(-0.08, 0.08, 3))).astype(np.float32),
        clouds=float(rng.uniform(0.0, 0.8) if sunny else rng.uniform(0.6, 1.0)),
        visibility_m=float(rng.uniform(300.0, 1500.0)),
        exposure=None,
        saturated=float(rng.uniform(0.04, 0.11) if sunny else rng.uniform(0.0, 0.04)),
        contrast=float(rng.uniform(1.2, 3.0)),
    )


def sky(weather: Weather, directions: Float32Array) -> Float32Array:
    """Colour of the sky along unit ``directions`` in the street frame, ``(3, N)`` both."""
    up = np.clip(directions[2], 0.0, 1.0)
    rgb = weather.horizon[:, None] + np.sqrt(up) * (weather.zenith - weather.horizon)[:, None]
    plane = directions[:2] / (up + 0.12)
    still = np.zeros_like(up)
    size = 0.006 / (up + 0.12)
    texels = Texels(plane[0], plane[1], size, size, still, still)
    cover = fractal(texels, (1.6, 1.6, 0.6), (0.6, 0.6, 0.35), (0.22, 0.22, 0.18)) + weather.clouds - 0.5
    fraction = np.clip(1.6 * cover, 0.0, 0.85)
    white = 0.88 + 0.08 * np.clip(cover, 0.0, 1.0)
    return np.asarray(rgb + fraction * (white - rgb), dtype=np.float32)


def light(weather: Weather, normals: Float32Array, lit: Float32Array) -> Float32Array:
    """Irradiance ``(3, N)`` on surfaces of unit normals ``(3, N)`` towards the viewer; ``lit`` is 1 in the sun."""
    direct = weather.sunshine * np.clip(weather.sun @ normals, 0.0, 1.0) * lit
    around = weather.ambient * (0.78 + 0.22 * normals[2])
    warm = np.array([[1.05], [1.0], [0.92]], dtype=np.float32)
    cool = np.array([[0.96], [1.0], [1.06]], dtype=np.float32)
    return np.asarray(direct * warm + around * cool, dtype=np.float32)


def paint(mesh: Mesh, hits: Hits, lit: Float32Array, weather: Weather, focal_px: float) -> Float32Array:
    """Colour ``(3, N)`` of each hit on a mesh in the open; ``lit`` ``(N,)`` is 1 where the sun is seen."""
    rgb = unlit(mesh, hits, focal_px)
    if weather.contrast != 1.0:
        base = np.take(mesh.colours[0], np.take(mesh.instance, hits.triangle), axis=1)
        rgb *= np.clip(1.15 * rgb / base, 0.2, 2.0) ** np.float32(weather.contrast - 1.0)
    rgb *= light(weather, hits.normals, lit)
    haze = -np.expm1(-hits.distance / np.float32(weather.visibility_m))
    return np.asarray(rgb + haze * (weather.horizon[:, None] - rgb), dtype=np.float32)
