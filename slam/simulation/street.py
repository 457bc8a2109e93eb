"""An embedded street world: images, exact depth, exact poses and LiDAR scans of a simulated drive.

Surfaces are ray-cast with Open3D; everything else is NumPy (``slam/simulation``).
"""

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.runtime.imports import import_open3d
from slam.simulation import hazards as effects
from slam.simulation.geometry import Float32Array, FloatArray, Mesh, Moving
from slam.simulation.hazards import Traffic
from slam.simulation.light import draw_varied_weather, draw_weather, paint, sky
from slam.simulation.objects import bonnet
from slam.simulation.options import SimulationOptions
from slam.simulation.route import plan_route
from slam.simulation.sensors import KITTI_CAMERA, T_CAMERA_LIDAR, beam_directions, measured, square_camera
from slam.simulation.surface import Hits, Surface, place_rays
from slam.simulation.town import build_town
from slam.simulation.variety import draw_variety
from slam.simulation.world import SimulatedWorld, in_bytes, through_lens

_DARKEST_MEAN = 0.33  # of an image, to which a camera exposes at least


class SimulatedStreet(SimulatedWorld):
    """A street world and a drive through it; the attributes are those of `SimulatedWorld`."""

    camera_height_m: float
    T_camera_lidar: FloatArray

    def __init__(self, options: SimulationOptions) -> None:
        """Plan the drive; ``SequenceError`` where there are too few frames for the route."""
        size = options.width, options.height
        still = effects.STILL_FRAMES if "stop" in options.hazards else 0
        variety = draw_variety(options.seed, options.route == "straight") if options.varied else None
        camera = KITTI_CAMERA.resized(*size) if variety is None else variety.camera(*size)
        if options.fov_deg is not None:
            camera = square_camera(*size, options.fov_deg)
        self._route = plan_route(options.route, options.frames, options.seed, still, variety)
        super().__init__(options, camera, self._route.T_street_camera)
        self.camera_height_m = self._route.camera_height_m
        self.T_camera_lidar = T_CAMERA_LIDAR.copy()
        self._variety = variety
        self._weather = draw_varied_weather(options.seed) if options.varied else draw_weather(options.seed)
        self._exposure = effects.exposure_curve(options.seed, options.frames)
        self._traffic = Traffic(self._route, options.seed, options.varied) if "moving-cars" in options.hazards else None

    def scan(self, index: int) -> Float32Array:
        """LiDAR points of one frame: x, y, z in the LiDAR frame, metres, and reflectance, ``(M, 4)``."""
        self._require(index)
        rng = np.random.default_rng([self.options.seed, 40, index])
        directions = beam_directions(rng)
        T_street_lidar = self._route.T_street_camera[index] @ self.T_camera_lidar
        rays = place_rays(T_street_lidar, directions)
        ranges = np.full(len(rays), np.inf, dtype=np.float32)
        reflectance = np.zeros(len(rays), dtype=np.float32)
        for surface in self._surfaces(index):
            answer = surface.cast(rays)
            nearer = np.flatnonzero(answer["t_hit"] < ranges)
            ranges[nearer] = answer["t_hit"][nearer]
            instance = surface.mesh.instance[answer["primitive_ids"][nearer]]
            reflectance[nearer] = surface.mesh.colours[0][:, instance].mean(axis=0)
        return measured(directions, ranges, reflectance, rng)

    def _build(self) -> Mesh:
        return build_town(self._route.plan, self._route.bend, self.options.seed, self.options.varied)

    def _moving(self, index: int) -> list[Mesh]:
        cars = self._traffic.placed(index) if self._traffic else []
        return cars + (self._bonnet.placed({0: self._route.T_street_camera[index]}) if self._bonnet else [])

    @functools.cached_property
    def _bonnet(self) -> Moving | None:
        """The bonnet of the own car; none under motion blur, which would smear it against the camera."""
        if self._variety is None or self._variety.bonnet == 0.0 or "blur" in self.options.hazards:
            return None
        rng = np.random.default_rng([self.options.seed, 12])
        below = (self.options.height * (1.0 - self._variety.bonnet) - self.camera.cy) / self.camera.fy
        return Moving(rng, [lambda soup: bonnet(soup, rng, below, self.camera_height_m)])

    @functools.cached_property
    def _gain(self) -> float:
        """Of the camera, constant over the drive."""
        if self._weather.exposure is not None:
            return self._weather.exposure
        frames = (0, len(self) // 2, len(self) - 1)
        views = [self._view(self._surfaces(index), self._route.T_street_camera[index])[0] for index in frames]
        brightest = float(np.quantile(np.max(views, axis=-1), 1.0 - self._weather.saturated))
        return max(1.0 / brightest, _DARKEST_MEAN / float(np.mean(np.minimum(views, brightest))))

    def _exposures(self, index: int) -> FloatArray:
        if "blur" in self.options.hazards:
            return effects.shutter_poses(self._route.T_street_camera, index)
        return self._route.T_street_camera[index : index + 1]

    def _background(self, directions: Float32Array) -> Float32Array:
        return sky(self._weather, directions)

    def _shade(
        self, surfaces: list[Surface], number: int, hits: Hits, rays: Float32Array, pixels: NDArray[np.int64]
    ) -> Float32Array:
        towards = np.flatnonzero(self._weather.sun @ hits.normals > 0.0)
        to_sun = np.take(rays, towards, axis=0)
        to_sun[:, :3] += to_sun[:, 3:] * hits.depth[towards, None] + 0.03 * hits.normals[:, towards].T
        to_sun[:, 3:] = self._weather.sun
        tensor = import_open3d().core.Tensor(to_sun)
        shadow = np.any([surface.scene.test_occlusions(tensor).numpy() for surface in surfaces], axis=0)
        lit = np.ones(self.options.height * self.options.width, dtype=np.float32)
        lit[pixels[towards]] = 1.0 - shadow
        soft = cv2.blur(lit.reshape(self.options.height, self.options.width), (3, 3))  # over neighbouring pixels
        lit = np.asarray(np.take(soft, pixels), dtype=np.float32)
        return paint(surfaces[number].mesh, hits, lit, self._weather, self.camera.fx)

    def _develop(self, rgb: Float32Array, index: int) -> NDArray[np.uint8]:
        """Rain, lens blur, exposure, and quantisation to 8 bits."""
        rgb = rgb * np.float32(self._gain)
        if "rain" in self.options.hazards:
            rgb = effects.rained_on(rgb, self.options.seed, index)
        rgb = through_lens(rgb) if self._variety is None else through_lens(rgb, self._variety.blur_px)
        if "exposure" in self.options.hazards:
            rgb = effects.exposed(rgb, float(self._exposure[index, 0]), float(self._exposure[index, 1]))
        if self._variety is not None:
            rgb = effects.sensed(rgb, self._variety.vignette, self._variety.noise, self.options.seed, index)
        return in_bytes(rgb)
