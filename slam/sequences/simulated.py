"""An embedded street world: images, exact depth, exact poses and LiDAR scans of a simulated drive.

Surfaces are ray-cast with Open3D; everything else is NumPy (``slam/sequences/simulation``).
"""

import functools
from dataclasses import dataclass
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from slam import se3
from slam.errors import SequenceError
from slam.foreign import import_open3d
from slam.sequences.simulation.geometry import Float32Array, FloatArray, Mesh
from slam.sequences.simulation.light import draw_weather, sky
from slam.sequences.simulation.optics import kitti_intrinsics, pixel_rays
from slam.sequences.simulation.painter import Hits, facing_normals, paint
from slam.sequences.simulation.route import plan_drive
from slam.sequences.simulation.town import build_town

Route = Literal["loop", "grid", "straight"]
Hazard = Literal["moving-cars", "exposure", "blur", "stop", "rain"]

FPS = 10.0
STILL_FRAMES = 30
FARTHEST = 200.0  # depth beyond this is called nothing, metres


@dataclass(frozen=True)
class SimulationOptions:
    """What to simulate; ``seed`` decides everything that the other options leave open."""

    route: Route = "loop"
    frames: int = 300
    seed: int = 0
    width: int = 416
    height: int = 128
    hazards: tuple[Hazard, ...] = ()


@dataclass(frozen=True)
class SimulatedFrame:
    """One frame with its truth.

    Attributes:
        index: number of the frame.
        stamp: seconds.
        image: ``(H, W, 3)`` uint8 RGB.
        depth: z-depth in metres, 0 where nothing was hit, ``(H, W)`` float32.
        T_world_camera: pose in the frame of the first camera, ``(4, 4)``.
    """

    index: int
    stamp: float
    image: NDArray[np.uint8]
    depth: Float32Array
    T_world_camera: FloatArray


class SimulatedStreet:
    """A street world and a drive through it; frames are rendered when asked for."""

    def __init__(self, options: SimulationOptions) -> None:
        _check(options)
        self.options = options
        self.K: FloatArray = kitti_intrinsics(options.width, options.height)
        drive = plan_drive(
            options.route, options.frames, options.seed, STILL_FRAMES if "stop" in options.hazards else 0
        )
        self.camera_height_m = drive.camera_height_m
        self._drive = drive
        self.T_world_camera: FloatArray = se3.invert(drive.T_street_camera[0]) @ drive.T_street_camera
        self.T_world_camera[0] = np.eye(4)
        self._weather = draw_weather(options.seed)
        self._rays = pixel_rays(self.K, options.width, options.height)

    def __len__(self) -> int:
        """Number of frames."""
        return self.options.frames

    def render(self, index: int) -> SimulatedFrame:
        """Image and depth of one frame; the same index gives the same bytes."""
        if not 0 <= index < len(self):
            raise IndexError(f"the simulated drive has frames 0 to {len(self) - 1}; asked for {index}")
        rgb, depth = self._cast(self._drive.T_street_camera[index])
        image = self._develop(rgb)
        return SimulatedFrame(index, index / FPS, image, depth, self.T_world_camera[index])

    @functools.cached_property
    def _mesh(self) -> Mesh:
        return build_town(self._drive.plan, self._drive.bend, self.options.seed)

    @functools.cached_property
    def _scene(self) -> Any:
        open3d = import_open3d()
        scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(
            open3d.core.Tensor(self._mesh.vertices), open3d.core.Tensor(self._mesh.triangles)
        )
        return scene

    def _cast(self, T_street_camera: FloatArray) -> tuple[Float32Array, Float32Array]:
        """Linear colour ``(H, W, 3)`` and z-depth ``(H, W)`` from a pose."""
        height, width = self.options.height, self.options.width
        directions = self._rays @ T_street_camera[:3, :3].T.astype(np.float32)
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = T_street_camera[:3, 3], directions
        answer = self._scene.cast_rays(import_open3d().core.Tensor(rays))
        depth = answer["t_hit"].numpy()  # rays have z = 1
        seen = np.flatnonzero(depth < FARTHEST)
        unseen = np.flatnonzero(~(depth < FARTHEST))
        length = np.linalg.norm(self._rays, axis=1)
        unit = directions / length[:, None]
        hits = Hits(
            triangle=answer["primitive_ids"].numpy()[seen].astype(np.int64),
            barycentric=answer["primitive_uvs"].numpy()[seen],
            rays=unit[seen],
            depth=depth[seen],
            distance=depth[seen] * length[seen],
        )
        normals = facing_normals(self._mesh, hits)
        points = rays[seen, :3] + directions[seen] * hits.depth[:, None]
        lit = self._sunlit(points, normals, seen)
        rgb = np.empty((len(directions), 3), dtype=np.float32)
        rgb[seen] = paint(self._mesh, hits, normals, lit, self._weather, float(self.K[0, 0]))
        rgb[unseen] = sky(self._weather, unit[unseen])
        depth[unseen] = 0.0
        return rgb.reshape(height, width, 3), depth.reshape(height, width)

    def _sunlit(self, points: Float32Array, normals: Float32Array, seen: NDArray[np.int64]) -> Float32Array:
        """Whether the sun reaches each point, softened over the neighbouring pixels, ``(N,)``."""
        rays = np.empty((len(points), 6), dtype=np.float32)
        rays[:, :3] = points + 0.03 * normals
        rays[:, 3:] = self._weather.sun
        shadow = self._scene.test_occlusions(import_open3d().core.Tensor(rays)).numpy()
        lit = np.ones(self.options.height * self.options.width, dtype=np.float32)
        lit[seen] = 1.0 - shadow
        soft = cv2.blur(lit.reshape(self.options.height, self.options.width), (3, 3))
        return np.asarray(soft.ravel()[seen], dtype=np.float32)

    def _develop(self, rgb: Float32Array) -> NDArray[np.uint8]:
        """Exposure, the lens's slight softness, and 8 bits."""
        soft = cv2.GaussianBlur(rgb * np.float32(255.0 * self._weather.exposure), (3, 3), 0.55)
        return np.asarray(np.clip(soft + 0.5, 0.0, 255.0)).astype(np.uint8)


def _check(options: SimulationOptions) -> None:
    """Refuse options that mean nothing."""
    if options.route not in get_args(Route):
        raise SequenceError(f"route must be one of {', '.join(get_args(Route))}; got {options.route!r}")
    for hazard in options.hazards:
        if hazard not in get_args(Hazard):
            raise SequenceError(f"hazards are {', '.join(get_args(Hazard))}; got {hazard!r}")
    if options.seed < 0:
        raise SequenceError(f"seed must be 0 or more; got {options.seed}")
    if min(options.width, options.height) < 8:
        raise SequenceError(f"images must be at least 8 x 8; got {options.width} x {options.height}")
