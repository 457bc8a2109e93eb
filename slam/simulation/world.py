"""A simulated world: surfaces that rays meet, a camera that moves among them, and the truth.

Rays are cast with Open3D; surfaces have a colour where they are met.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.formats.ply import Ply, distances, scene_of
from slam.frames import Float32Array, Intrinsics
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.runtime.imports import import_open3d
from slam.simulation.geometry import Mesh
from slam.simulation.options import SimulationOptions
from slam.simulation.room_textures import ROOM_SHADERS
from slam.simulation.street_textures import STREET_SHADERS
from slam.simulation.texture import Axis, Texels

FARTHEST_M = 200.0  # surfaces beyond are treated as sky
_SHADERS = STREET_SHADERS | ROOM_SHADERS
MATERIALS = tuple(_SHADERS)


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


def place_rays(T_scene_sensor: FloatArray, directions: Float32Array) -> Float32Array:
    """Origin and direction in the scene of directions ``(N, 3)`` in a sensor's frame, ``(N, 6)``.

    Of several poses ``(H, 4, 4)`` each is that of an equal share of the directions in turn, as of
    the rows of an image.
    """
    poses = T_scene_sensor.reshape(-1, 4, 4)
    of_pose = directions.reshape(len(poses), -1, 3)
    rays = np.empty((*of_pose.shape[:2], 6), dtype=np.float32)
    rays[..., :3] = poses[:, None, :3, 3]
    rays[..., 3:] = of_pose @ poses[:, :3, :3].swapaxes(1, 2).astype(np.float32)
    return rays.reshape(-1, 6)


def between(corners: Float32Array, barycentric: Float32Array) -> Float32Array:
    """Values at points of triangles by those of the three corners ``(3, ..., N)``, ``(..., N)``."""
    first, second, third = corners
    b1, b2 = barycentric
    return first + b1 * (second - first) + b2 * (third - first)


@dataclass(frozen=True)
class Hits:
    """Rays that met a surface."""

    surface: Surface  # that was met
    triangle: NDArray[np.int64]  # of its mesh, (N,)
    barycentric: Float32Array  # weights of its second and third corner, (2, N)
    rays: Float32Array  # origins and directions of z-depth one, (N, 6)
    directions: Float32Array  # the same of length one, (3, N)
    normals: Float32Array  # unit, turned towards the viewer, (3, N)
    depth: Float32Array  # z-depth, metres, (N,)
    pixels: NDArray[np.int64]  # that the rays go through, (N,)

    def unlit(self, focal_px: float) -> Float32Array:
        """Colour of each under white light, ``(3, N)``, at a focal length in pixels."""
        mesh = self.surface.mesh
        u_size, v_size = self._footprint(self.depth / np.float32(focal_px))
        corners = np.take(mesh.uv, self.triangle, axis=2)  # (3, 2, N)
        u, v = between(corners, self.barycentric)
        instances = np.take(mesh.instance, self.triangle)
        materials = np.take(mesh.material, self.triangle)
        rgb = np.empty((3, len(self.triangle)), dtype=np.float32)
        for kind in np.unique(materials):
            part = np.flatnonzero(materials == kind)
            instance = instances[part]
            shift_u, shift_v = np.take(mesh.offsets, instance, axis=1)
            first, second = np.take(mesh.colours, instance, axis=2)
            texels = Texels(
                Axis(u[part], u_size[part], shift_u),
                Axis(v[part], v_size[part], shift_v),
                first,
                second,
                np.take(mesh.parameters, instance, axis=1),
            )
            rgb[:, part] = _SHADERS[MATERIALS[kind]](texels)
        return rgb

    def _footprint(self, pixel: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Extent of a pixel on the surface along its u and v axes, grazing angle included.

        A round pixel of size f ``(N,)``, metres at the surface's distance, seen by rays at angle a
        to the normals is an ellipse of axes f and f / cos a; along a tangent t it extends
        f sqrt(1 + (ray . t)^2 / cos^2 a).
        """
        tangents = np.take(self.surface.mesh.tangents, self.triangle, axis=1)
        cosine = np.abs((self.directions * self.normals).sum(axis=0))
        along_u = (self.directions * tangents).sum(axis=0)
        cosine2 = np.maximum(cosine * cosine, 1e-4)
        u2 = along_u * along_u
        v2 = np.maximum(1.0 - cosine * cosine - u2, 0.0)
        return pixel * np.sqrt(1.0 + u2 / cosine2), pixel * np.sqrt(1.0 + v2 / cosine2)


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

    @property
    @abstractmethod
    def _still(self) -> Surface:
        """Every surface that stands still."""

    @abstractmethod
    def _moving(self, index: int) -> list[Mesh]:
        """What moves, as it is at a frame."""

    def _background(self, directions: Float32Array) -> Float32Array:
        """Colour along unit directions that meet nothing, ``(3, N)`` both: black indoors."""
        return np.zeros_like(directions)

    @abstractmethod
    def _shade(self, hits: Hits, surfaces: list[Surface]) -> Float32Array:
        """Colour of hits, RGB about [0, 1], ``(3, N)``; the surfaces are all of the frame."""

    @abstractmethod
    def _poses(self, seconds: FloatArray) -> FloatArray:
        """``T_scene_camera`` at times ``(N,)`` of the drive, ``(N, 4, 4)``; its ends are held."""

    @abstractmethod
    def _shutter(self, index: int) -> tuple[float, int]:
        """How long the shutter is open for a blurred frame, seconds, and of how many images."""

    @abstractmethod
    def _develop(self, rgb: Float32Array, index: int) -> Float32Array:
        """The image, about [0, 1], of light ``(H, W, 3)`` that fell on the sensor."""

    def __len__(self) -> int:
        """Number of frames."""
        return self.options.frames

    def render(self, index: int) -> NDArray[np.uint8]:
        """RGB image ``(H, W, 3)`` of one frame; the same index gives the same bytes."""
        surfaces = self._surfaces(index)
        views = [self._view(surfaces, T_scene_camera) for T_scene_camera in self._exposures(index)]
        levels = self._develop(np.mean(views, axis=0), index) * np.float32(255.0) + np.float32(0.5)
        return np.clip(levels, 0.0, 255.0).astype(np.uint8)

    def _exposures(self, index: int) -> FloatArray:
        """Poses ``(S, R, 4, 4)`` of the images whose mean a frame is, one a row or one for all."""
        offsets, options = np.zeros((1, 1)), self.options
        if "blur" in options.hazards:
            open_s, samples = self._shutter(index)
            offsets = open_s * ((np.arange(samples)[:, None] + 0.5) / samples - 0.5)
        if options.readout_s:
            rows = (np.arange(options.height) + 0.5) / options.height - 0.5
            offsets = offsets + options.readout_s * rows
        poses = self._poses(index / options.rate + offsets.ravel())
        return poses.reshape(*offsets.shape, 4, 4)

    def depth(self, index: int) -> Float32Array:
        """The z-depth of one frame in metres, 0 where nothing was hit, ``(H, W)``."""
        rays = place_rays(self._T_scene_camera[index], self._rays)
        depth: Float32Array = np.min(
            [surface.cast(rays)["t_hit"] for surface in self._surfaces(index)], axis=0
        )
        depth[depth >= FARTHEST_M] = 0.0
        return depth.reshape(self.options.height, self.options.width)

    def distance_to_surface(self, points_world: FloatArray) -> FloatArray:
        """Distance in metres from points ``(M, 3)`` to the nearest static surface, ``(M,)``."""
        return distances(self._still.scene, se3.apply(self._T_scene_camera[0], points_world))

    def mesh_world(self) -> Ply:
        """What stands still, in the frame of the first camera."""
        mesh, T_world_scene = self._still.mesh, se3.invert(self._T_scene_camera[0])
        points = se3.apply(T_world_scene, mesh.vertices.astype(np.float64)).astype("<f4")
        vertices = points.view([(axis, "<f4") for axis in "xyz"])[:, 0]
        return Ply(vertices, mesh.triangles.astype(np.int64))

    def scan(self, index: int) -> Float32Array:
        """LiDAR points of a frame ``(M, 4)``: x, y, z in the LiDAR, metres, and reflectance."""
        raise NotImplementedError(f"frame {index}: this world has no LiDAR")

    def _surfaces(self, index: int) -> list[Surface]:
        """The surfaces at a frame: what stands still, and what moves."""
        return [self._still, *map(Surface, self._moving(index))]

    def _view(self, surfaces: list[Surface], T_scene_camera: FloatArray) -> Float32Array:
        """Colour ``(H, W, 3)``, about [0, 1], from a pose, or one a row."""
        rays = place_rays(T_scene_camera, self._rays)  # z = 1, so that t is z-depth
        rgb = self._colours(surfaces, rays, self._stretch)
        return rgb.reshape(self.options.height, self.options.width, 3)

    def _colours(
        self, surfaces: list[Surface], rays: Float32Array, stretch: Float32Array
    ) -> Float32Array:
        """Colour along rays ``(N, 6)`` whose directions have lengths ``(N,)``, ``(N, 3)``."""
        unit = np.ascontiguousarray(rays[:, 3:].T) / stretch  # (3, N)
        answers = [surface.cast(rays) for surface in surfaces]
        depths = np.stack([answer["t_hit"] for answer in answers])
        nearest, depth = np.argmin(depths, axis=0), depths.min(axis=0)
        rgb = np.empty((len(rays), 3), dtype=np.float32)
        unseen = np.flatnonzero(depth >= FARTHEST_M)
        rgb[unseen] = self._background(unit[:, unseen]).T
        for number, (surface, answer) in enumerate(zip(surfaces, answers)):
            seen = np.flatnonzero((nearest == number) & (depth < FARTHEST_M))
            triangle = answer["primitive_ids"][seen].astype(np.int64)
            directions = np.take(unit, seen, axis=1)
            normals = np.take(surface.mesh.normals, triangle, axis=1)
            normals = np.asarray(normals * -np.sign((normals * directions).sum(axis=0)))
            barycentric = np.take(answer["primitive_uvs"], seen, axis=0).T
            hits = Hits(
                surface, triangle, barycentric, rays[seen], directions, normals, depth[seen], seen
            )
            rgb[seen] = self._shade(hits, surfaces).T
        return rgb
