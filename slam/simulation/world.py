"""A simulated world: surfaces that rays meet, a camera that moves among them, and the truth.

Rays are cast with Open3D; surfaces have a colour where they are met.
"""

import functools
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.formats.ply import distances, scene_of
from slam.frames import Intrinsics
from slam.geometry import se3
from slam.runtime.imports import import_open3d
from slam.simulation.geometry import Float32Array, FloatArray, Material, Mesh
from slam.simulation.options import SimulationOptions
from slam.simulation.room_textures import ROOM_SHADERS
from slam.simulation.street_textures import STREET_SHADERS
from slam.simulation.texture import Texels

FARTHEST_M = 200.0  # surfaces beyond are treated as sky
SHADERS = STREET_SHADERS | ROOM_SHADERS
SHUTTER = 0.5  # exposure time of a blurred image over the frame interval


class Surface:
    """A mesh and its ray casting scene."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh, self.scene = mesh, scene_of(mesh.vertices, mesh.triangles)

    def cast(self, rays: Float32Array) -> dict[str, NDArray[Any]]:
        """Where rays ``(N, 6)`` meet it, by Open3D's names.

        They are ``t_hit`` (infinite if nowhere), the triangle and barycentric weights.
        """
        answer = self.scene.cast_rays(import_open3d().core.Tensor(rays))
        return {name: answer[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_uvs")}

    def unlit(self, hits: "Hits", focal_px: float) -> Float32Array:
        """Colour of each hit under white light, ``(3, N)`` at a focal length in pixels."""
        mesh = self.mesh
        tangents = np.take(mesh.tangents, hits.triangle, axis=1)
        u_size, v_size = _footprint(
            hits.depth / np.float32(focal_px), hits.rays, hits.normals, tangents
        )
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
            texels = Texels(
                u[part], v[part], u_size[part], v_size[part], offsets[0, part], offsets[1, part]
            )
            colours = np.take(mesh.colours, instance[part], axis=2)
            parameters = np.take(mesh.parameters, instance[part], axis=1)
            rgb[:, part] = SHADERS[Material(kind)](texels, colours, parameters)
        return rgb


def place_rays(T_scene_sensor: FloatArray, directions: Float32Array) -> Float32Array:
    """Origin and direction in the scene of directions ``(N, 3)`` in a sensor's frame, ``(N, 6)``.

    Of several poses ``(H, 4, 4)`` each is that of an equal share of the directions in turn, as of
    the rows of an image.
    """
    rays = np.empty((len(directions), 6), dtype=np.float32)
    if T_scene_sensor.ndim == 3:
        by_row = directions.reshape(len(T_scene_sensor), -1, 3)
        rays[:, :3] = np.repeat(T_scene_sensor[:, :3, 3], by_row.shape[1], axis=0)
        rays[:, 3:] = (
            by_row @ T_scene_sensor[:, :3, :3].swapaxes(1, 2).astype(np.float32)
        ).reshape(-1, 3)
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

    A round pixel of size f ``(N,)``, metres at the surface's distance, seen by rays at angle a to
    the normals is an ellipse of axes f and f / cos a; along a tangent t it extends
    f sqrt(1 + (ray . t)^2 / cos^2 a). All directions are unit, ``(3, N)``.
    """
    cosine = np.abs((rays * normals).sum(axis=0))
    along_u = (rays * tangents).sum(axis=0)
    cosine2 = np.maximum(cosine * cosine, 1e-4)
    u2 = along_u * along_u
    v2 = np.maximum(1.0 - cosine * cosine - u2, 0.0)
    return pixel * np.sqrt(1.0 + u2 / cosine2), pixel * np.sqrt(1.0 + v2 / cosine2)


@dataclass(frozen=True)
class SimulatedFrame:
    """One frame with its truth."""

    index: int  # number of the frame
    stamp: float  # seconds
    image: NDArray[np.uint8]  # (H, W, 3) uint8 RGB
    depth: Float32Array  # z-depth in metres, 0 where nothing was hit, (H, W) float32
    T_world_camera: FloatArray  # pose in the frame of the first camera, (4, 4)


class SimulatedWorld(ABC):
    """A world and a way through it; frames are rendered on demand.

    The scene is x east, y north, z up, metres.

    Attributes:
        options: what is simulated.
        camera: through which it is seen, with the read-out of its shutter.
        K: its matrix, ``(3, 3)``.
        T_world_camera: every pose in the frame of the first camera, ``(N, 4, 4)``.
        camera_height_m: of the camera above the road; None where there is no road.
        T_camera_lidar: ``(4, 4)``; None without a LiDAR.
    """

    camera_height_m: float | None = None
    T_camera_lidar: FloatArray | None = None

    def __init__(
        self, options: SimulationOptions, camera: Intrinsics, T_scene_camera: FloatArray
    ) -> None:
        """A world seen through a camera from poses ``(N, 4, 4)``."""
        self.options = options
        self.camera = replace(camera, readout_s=options.readout_s)
        self.K = camera.K
        self._T_scene_camera = T_scene_camera
        self.T_world_camera: FloatArray = se3.invert(T_scene_camera[0]) @ T_scene_camera
        self.T_world_camera[0] = np.eye(4)
        self._rays = camera.rays(camera.pixel_grid()).reshape(-1, 3).astype(np.float32)
        # ray length per depth
        self._stretch = np.linalg.norm(self._rays, axis=1).astype(np.float32)

    @abstractmethod
    def _build(self) -> Mesh:
        """Every surface that stands still."""

    @abstractmethod
    def _moving(self, index: int) -> list[Mesh]:
        """What moves, as it is at a frame."""

    @abstractmethod
    def _background(self, directions: Float32Array) -> Float32Array:
        """Colour along unit directions that meet nothing, ``(3, N)`` both."""

    @abstractmethod
    def _shade(
        self,
        surfaces: list[Surface],
        number: int,
        hits: Hits,
        rays: Float32Array,
        pixels: NDArray[np.int64],
    ) -> Float32Array:
        """Colour of hits on one of the surfaces.

        Args:
            surfaces: all of a frame.
            number: which of them is hit.
            hits: where, N of them.
            rays: that hit it, ``(N, 6)``.
            pixels: which the rays go through, ``(N,)``.

        Returns:
            RGB, about [0, 1], ``(3, N)``.
        """

    @abstractmethod
    def _exposures(self, index: int) -> FloatArray:
        """Poses from which the image is taken, which is their mean.

        They are ``(S, 4, 4)``, or ``(S, H, 4, 4)`` with one a row.
        """

    @abstractmethod
    def _develop(self, rgb: Float32Array, index: int) -> Float32Array:
        """The image, about [0, 1], of light ``(H, W, 3)`` that fell on the sensor."""

    def __len__(self) -> int:
        """Number of frames."""
        return self.options.frames

    def render(self, index: int) -> SimulatedFrame:
        """Image and depth of one frame; the same index gives the same bytes."""
        self._require(index)
        surfaces, poses = self._surfaces(index), self._exposures(index)
        views = (self._view(surfaces, T_scene_camera) for T_scene_camera in poses)
        if len(poses) == 1 and np.array_equal(poses[0], self._T_scene_camera[index]):
            rgb, depth = next(views)
        else:
            rgb, depth = np.mean([view[0] for view in views], axis=0), self.depth(index)
        levels = self._develop(rgb, index) * np.float32(255.0) + np.float32(0.5)
        image = np.clip(levels, 0.0, 255.0).astype(np.uint8)
        return SimulatedFrame(
            index, index / self.options.rate, image, depth, self.T_world_camera[index].copy()
        )

    def depth(self, index: int) -> Float32Array:
        """The z-depth ``(H, W)`` of `render`, without the image."""
        self._require(index)
        rays = place_rays(self._T_scene_camera[index], self._rays)
        depth: Float32Array = np.min(
            [surface.cast(rays)["t_hit"] for surface in self._surfaces(index)], axis=0
        )
        depth[depth >= FARTHEST_M] = 0.0
        return depth.reshape(self.options.height, self.options.width)

    def distance_to_surface(self, points_world: NDArray[np.floating[Any]]) -> FloatArray:
        """Distance in metres from points ``(M, 3)`` to the nearest static surface, ``(M,)``."""
        points = se3.apply(self._T_scene_camera[0], np.asarray(points_world, dtype=np.float64))
        return distances(self._still.scene, points)

    def mesh_world(self) -> tuple[Float32Array, NDArray[np.uint32]]:
        """What stands still: vertices ``(V, 3)`` in the first camera, triangles ``(T, 3)``."""
        mesh = self._still.mesh
        vertices = se3.apply(se3.invert(self._T_scene_camera[0]), mesh.vertices.astype(np.float64))
        return vertices.astype(np.float32), mesh.triangles

    def scan(self, index: int) -> Float32Array:
        """LiDAR points of a frame ``(M, 4)``: x, y, z in the LiDAR, metres, and reflectance."""
        raise NotImplementedError(f"frame {index}: this world has no LiDAR")

    @functools.cached_property
    def _still(self) -> Surface:
        return Surface(self._build())

    def _surfaces(self, index: int) -> list[Surface]:
        """The surfaces at a frame: what stands still, and what moves."""
        return [self._still, *map(Surface, self._moving(index))]

    def _view(
        self, surfaces: list[Surface], T_scene_camera: FloatArray
    ) -> tuple[Float32Array, Float32Array]:
        """Colour ``(H, W, 3)``, about [0, 1], and z-depth ``(H, W)`` from a pose, or one a row."""
        rays = place_rays(T_scene_camera, self._rays)  # z = 1, so that t is z-depth
        unit = np.ascontiguousarray(rays[:, 3:].T) / self._stretch  # (3, H * W)
        answers = [surface.cast(rays) for surface in surfaces]
        depths = np.stack([answer["t_hit"] for answer in answers])
        nearest, depth = np.argmin(depths, axis=0), depths.min(axis=0)
        depth[depth >= FARTHEST_M] = 0.0
        rgb = np.empty((len(rays), 3), dtype=np.float32)
        unseen = np.flatnonzero(depth == 0.0)
        rgb[unseen] = self._background(unit[:, unseen]).T
        for number, (surface, answer) in enumerate(zip(surfaces, answers)):
            seen = np.flatnonzero((nearest == number) & (depth > 0.0))
            triangle = answer["primitive_ids"][seen].astype(np.int64)
            order = np.argsort(np.take(surface.mesh.material, triangle), kind="stable")
            seen, triangle = seen[order], triangle[order]
            rays_seen = np.take(unit, seen, axis=1)
            normals = np.take(surface.mesh.normals, triangle, axis=1)
            hits = Hits(
                triangle=triangle,
                barycentric=np.take(answer["primitive_uvs"], seen, axis=0).T,
                rays=rays_seen,
                normals=np.asarray(
                    normals * -np.sign((normals * rays_seen).sum(axis=0))
                ),  # turned towards the viewer
                depth=depth[seen],
                distance=depth[seen] * self._stretch[seen],
            )
            rgb[seen] = self._shade(surfaces, number, hits, np.take(rays, seen, axis=0), seen).T
        shape = self.options.height, self.options.width
        return rgb.reshape(*shape, 3), depth.reshape(shape)

    def _require(self, index: int) -> None:
        if not 0 <= index < len(self):
            raise IndexError(
                f"the simulated drive has frames 0 to {len(self) - 1}; asked for {index}"
            )


def square_camera(width: int, height: int, fov_deg: float) -> Intrinsics:
    """Of square pixels with a horizontal field of view, its centre in the middle."""
    focal_px = float(0.5 * width / np.tan(0.5 * np.deg2rad(fov_deg)))
    return Intrinsics(width, height, focal_px, focal_px, 0.5 * (width - 1), 0.5 * (height - 1))


def through_lens(rgb: Float32Array, blur_px: float = 0.55) -> Float32Array:
    """An image as blurred as a lens blurs it."""
    return np.asarray(cv2.GaussianBlur(rgb, (3, 3), blur_px))
