"""A street as a world: images, exact depth and poses, and LiDAR scans of a drive under a sky.

Surfaces are ray-cast with Open3D; everything else is NumPy (``slam/simulation``).
"""

import functools
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slam.frames import Float32Array
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.runtime.imports import import_open3d
from slam.simulation.geometry import Mesh, luck
from slam.simulation.objects import bonnet, car
from slam.simulation.options import USUAL, SimulationOptions, draw_variety
from slam.simulation.route import STEP, Route, plan_route
from slam.simulation.shapes import things
from slam.simulation.texture import Axis, Texels
from slam.simulation.town import build_town
from slam.simulation.world import Hits, SimulatedWorld, Surface, place_rays

STILL_FRAMES = 30  # of a stop: 3 s at 10 frames a second
BLUR_SAMPLES = 6
SHUTTER = 0.5  # exposure time of a blurred image over the frame interval
WIDEST_LANE_M = 2.0  # from its middle to its edge
_DARKEST_MEAN = 0.33  # of an image, to which a camera exposes at least

BEAMS, COLUMNS = 64, 850
HIGHEST_DEG, LOWEST_DEG = 2.0, -24.8
NEAREST_M, FARTHEST_M = 2.0, 90.0
RANGE_NOISE_M, ELEVATION_NOISE = 0.02, 1e-3

# LiDAR: x forward, y left, z up; 8 cm above and 27 cm behind the camera, as on KITTI's car
T_CAMERA_LIDAR: FloatArray = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -0.08], [1.0, 0.0, 0.0, -0.27], [0.0, 0.0, 0.0, 1.0]]
)


class SimulatedStreet(SimulatedWorld):
    """A street world and a drive through it; the attributes are those of `SimulatedWorld`."""

    camera_height_m: float
    T_camera_lidar = T_CAMERA_LIDAR

    def __init__(self, options: SimulationOptions) -> None:
        """Plan the drive.

        Raises:
            SequenceError: if there are too few frames for the route.
        """
        size = options.width, options.height
        still = STILL_FRAMES if "stop" in options.hazards else 0
        variety, self._weather = USUAL, draw_weather(options.seed)
        if options.varied:
            variety = draw_variety(options.seed, options.route == "straight")
            self._weather = draw_varied_weather(options.seed)
        if options.fov_deg is not None:
            variety = replace(variety, fov_deg=options.fov_deg, aspect=None, centre=(0.0, 0.0))
        self._route = plan_route(options.route, options.frames, options.seed, still, variety)
        super().__init__(options, variety.camera(*size), self._route.T_street_camera)
        self.camera_height_m = self._route.camera_height_m
        self._variety = variety
        rng = luck(options.seed, 31)
        # gain and gamma of every frame, piecewise constant
        exposures: list[list[float]] = []
        while len(exposures) < options.frames:
            lasts = rng.integers(12, 45)
            exposures += [rng.uniform((0.55, 0.75), (1.5, 1.3)).tolist()] * lasts
        self._exposure = exposures
        self._traffic = (
            Traffic(self._route, options.seed, options.varied)
            if "moving-cars" in options.hazards
            else None
        )

    def scan(self, index: int) -> Float32Array:
        """LiDAR points of a frame ``(M, 4)``: x, y, z in the LiDAR, metres, and reflectance."""
        rng = luck(self.options.seed, 40, index)
        # each spin starts at a random angle: with the same rays in every scan the rings on the
        # ground would repeat exactly, and scan matching would estimate zero motion
        azimuth = (np.arange(COLUMNS) + rng.uniform()) * (2.0 * np.pi / COLUMNS)
        elevation = np.deg2rad(np.linspace(HIGHEST_DEG, LOWEST_DEG, BEAMS))[:, None]
        elevation = elevation + rng.normal(0.0, ELEVATION_NOISE, (BEAMS, COLUMNS))
        x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
        directions = np.stack([x, y, np.sin(elevation)], axis=-1).reshape(-1, 3).astype(np.float32)
        rays = place_rays(self._T_scene_camera[index] @ T_CAMERA_LIDAR, directions)
        ranges = np.full(len(rays), np.inf, dtype=np.float32)
        reflectance = np.zeros(len(rays), dtype=np.float32)
        for surface in self._surfaces(index):
            answer = surface.cast(rays)
            nearer = np.flatnonzero(answer["t_hit"] < ranges)
            ranges[nearer] = answer["t_hit"][nearer]
            instance = surface.mesh.instance[answer["primitive_ids"][nearer]]
            reflectance[nearer] = surface.mesh.colours[0][:, instance].mean(axis=0)
        returned = (ranges > NEAREST_M) & (ranges < FARTHEST_M)
        noisy = ranges[returned] + rng.normal(0.0, RANGE_NOISE_M, int(returned.sum()))
        return np.column_stack(
            [directions[returned] * noisy[:, None], reflectance[returned]]
        ).astype(np.float32)

    @functools.cached_property
    def _still(self) -> Surface:
        plan, bend = self._route.plan, self._route.bend
        return Surface(build_town(plan, bend, self.options.seed, self.options.varied))

    def _moving(self, index: int) -> list[Mesh]:
        cars = self._traffic.placed(index) if self._traffic else []
        return cars + [each.placed(self._T_scene_camera[index]) for each in self._bonnet]

    @functools.cached_property
    def _bonnet(self) -> list[Mesh]:
        """The bonnet of the own car; none under motion blur, which would smear it."""
        if self._variety.bonnet == 0.0 or "blur" in self.options.hazards:
            return []
        rng = luck(self.options.seed, 12)
        below = (
            self.options.height * (1.0 - self._variety.bonnet) - self.camera.cy
        ) / self.camera.fy
        return things(rng, [lambda site: bonnet(site, below, self.camera_height_m)])

    @functools.cached_property
    def _gain(self) -> float:
        """Of the camera, constant over the drive."""
        if self._weather.exposure is not None:
            return self._weather.exposure
        frames = (0, len(self) // 2, len(self) - 1)
        views = [self._view(self._surfaces(index), self._T_scene_camera[index]) for index in frames]
        brightest = float(np.quantile(np.max(views, axis=-1), 1.0 - self._weather.saturated))
        return max(1.0 / brightest, _DARKEST_MEAN / float(np.mean(np.minimum(views, brightest))))

    def _poses(self, seconds: FloatArray) -> FloatArray:
        frames = np.arange(len(self), dtype=np.float64)
        return se3.interpolate(self._T_scene_camera, frames, seconds * self.options.rate)

    def _shutter(self, index: int) -> tuple[float, int]:
        return SHUTTER / self.options.rate, BLUR_SAMPLES

    def _background(self, directions: Float32Array) -> Float32Array:
        weather, up = self._weather, np.clip(directions[2], 0.0, 1.0)
        rgb = weather.horizon[:, None] + np.sqrt(up) * (weather.zenith - weather.horizon)[:, None]
        plane = directions[:2] / (up + 0.12)
        still = np.zeros_like(up)
        size = 0.006 / (up + 0.12)
        x, y = (Axis(at, size, still) for at in plane)
        cover = (
            Texels(x, y, rgb, rgb, rgb).fractal(
                (1.6, 1.6, 0.6), (0.6, 0.6, 0.35), (0.22, 0.22, 0.18)
            )
            + weather.clouds
            - 0.5
        )
        fraction = np.clip(1.6 * cover, 0.0, 0.85)
        white = 0.88 + 0.08 * np.clip(cover, 0.0, 1.0)
        return rgb + fraction * (white - rgb)

    def _shade(self, hits: Hits, surfaces: list[Surface]) -> Float32Array:
        weather, mesh = self._weather, hits.surface.mesh
        towards = np.flatnonzero(weather.sun @ hits.normals > 0.0)
        to_sun = np.take(hits.rays, towards, axis=0)
        to_sun[:, :3] += (
            to_sun[:, 3:] * hits.depth[towards, None] + 0.03 * hits.normals[:, towards].T
        )
        to_sun[:, 3:] = weather.sun
        tensor = import_open3d().core.Tensor(to_sun)
        shadow = np.any(
            [surface.scene.test_occlusions(tensor).numpy() for surface in surfaces], axis=0
        )
        lit = np.ones(self.options.height * self.options.width, dtype=np.float32)
        lit[hits.pixels[towards]] = 1.0 - shadow
        # over neighbouring pixels
        soft = cv2.blur(lit.reshape(self.options.height, self.options.width), (3, 3))
        lit = np.asarray(np.take(soft, hits.pixels), dtype=np.float32)
        rgb = hits.unlit(self.camera.fx)
        if weather.contrast != 1.0:
            base = np.take(mesh.colours[0], np.take(mesh.instance, hits.triangle), axis=1)
            rgb *= np.clip(1.15 * rgb / base, 0.2, 2.0) ** np.float32(weather.contrast - 1.0)
        direct = weather.sunshine * np.clip(weather.sun @ hits.normals, 0.0, 1.0) * lit
        around = weather.ambient * (0.78 + 0.22 * hits.normals[2])
        warm = np.array([[1.05], [1.0], [0.92]], dtype=np.float32)
        cool = np.array([[0.96], [1.0], [1.06]], dtype=np.float32)
        rgb *= np.asarray(direct * warm + around * cool, dtype=np.float32)  # irradiance
        distance = hits.depth * self._stretch[hits.pixels]
        haze = -np.expm1(-distance / np.float32(weather.visibility_m))
        return rgb + haze * (weather.horizon[:, None] - rgb)

    def _develop(self, rgb: Float32Array, index: int) -> Float32Array:
        """Rain, lens blur and exposure."""
        rgb = rgb * np.float32(self._gain)
        if "rain" in self.options.hazards:
            rgb = rained_on(rgb, self.options.seed, index)
        rgb = cv2.GaussianBlur(rgb, (3, 3), self._variety.blur_px)
        if "exposure" in self.options.hazards:
            gain, gamma = self._exposure[index]
            rgb = np.asarray(gain * np.power(np.clip(rgb, 0.0, 1.0), gamma), dtype=np.float32)
        if self.options.varied:
            y, x = (np.linspace(-1.0, 1.0, side, dtype=np.float32) for side in rgb.shape[:2])
            falloff = 1.0 - np.float32(0.5 * self._variety.vignette) * (x * x + (y * y)[:, None])
            grain = luck(self.options.seed, 35, index).standard_normal(rgb.shape, dtype=np.float32)
            rgb = np.asarray(rgb * falloff[..., None] + np.float32(self._variety.noise) * grain)
        return rgb


def rained_on(rgb: Float32Array, seed: int, index: int) -> Float32Array:
    """Rain streaks and reduced contrast over an image ``(H, W, 3)`` about [0, 1]."""
    rng = luck(seed, 32, index)
    height, width = rgb.shape[:2]
    drops = (rng.random((height, width)) < 0.005).astype(np.float32) * rng.uniform(0.4, 1.0)
    length = max(3, height // 11)
    kernel = np.zeros((length, length), dtype=np.float32)
    slant = rng.uniform(-0.3, 0.3)
    rows = np.arange(length)
    kernel[rows, (length / 2 + slant * (rows - length / 2)).astype(int)] = 1.0
    streaks = np.clip(cv2.filter2D(drops, -1, kernel), 0.0, 1.0)[..., None] * 0.4
    veiled = rgb * 0.85 + 0.07
    return veiled + streaks * (0.85 - veiled)


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
    # gain of the camera; None sets it so that a share of the pixels saturates
    exposure: float | None
    saturated: float = 0.0  # that share
    contrast: float = 1.0  # of textures, an exponent; 1 as they are painted


def draw_weather(seed: int) -> Weather:
    """Weather of a world."""
    rng = luck(seed, 20)
    azimuth, elevation = rng.uniform((0.0, 0.5), (2.0 * np.pi, 1.1))
    level = np.cos(elevation)
    sun = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    sunshine = rng.uniform(0.25, 0.75)
    sky = np.array([(0.38, 0.56, 0.85), (0.80, 0.84, 0.88)]) + rng.uniform(-0.06, 0.06, (2, 3))
    zenith, horizon = sky.astype(np.float32)
    return Weather(
        sun=sun.astype(np.float32),
        sunshine=sunshine,
        ambient=0.95 - 0.6 * sunshine,
        zenith=zenith,
        horizon=horizon,
        clouds=rng.uniform(0.0, 1.0),
        visibility_m=rng.uniform(220.0, 600.0),
        exposure=rng.uniform(0.95, 1.2),
    )


def draw_varied_weather(seed: int) -> Weather:
    """Weather of a varied world: under the same sun another light, and another camera's gain.

    Three in four have a sun beside which shadows are 3 to 10 times as dark.
    """
    rng, usual = luck(seed, 21), draw_weather(seed)
    if rng.random() < 0.75:
        ambient = np.exp(-rng.uniform(np.log(3.0), np.log(10.0)))
        bright, clouds, saturated = rng.uniform((0.6, 0.0, 0.04), (1.3, 0.8, 0.11))
    else:
        ambient = rng.uniform(0.6, 0.95)
        bright, clouds, saturated = rng.uniform((0.9, 0.6, 0.0), (1.4, 1.0, 0.04))
    return replace(
        usual,
        sunshine=(1.0 - ambient) / usual.sun[2],  # a level road has 1 in the sun
        ambient=ambient,
        zenith=np.float32(bright) * usual.zenith,
        horizon=np.float32(bright) * usual.horizon,
        clouds=clouds,
        visibility_m=rng.uniform(300.0, 1500.0),
        exposure=None,
        saturated=saturated,
        contrast=rng.uniform(1.2, 3.0),
    )


class Traffic:
    """Moving cars: one ahead of the camera for a while, others oncoming; some may overtake it."""

    def __init__(self, drive: Route, seed: int, overtaking: bool = False) -> None:
        rng = luck(seed, 33)
        self._route = drive
        # lane samples at each frame, to the left in metres, along the lane or against it
        self._courses: list[tuple[FloatArray, float, float]] = []
        meets = rng.uniform(4.0, 15.0)
        while meets < len(drive.sample):
            speed = -rng.uniform(0.7, 1.2) / STEP
            left_m = 2.0 * drive.lane_offset_m + rng.uniform(0.0, 0.3)
            self._courses.append((self._beside_at(meets, speed), left_m, -1.0))
            meets += rng.uniform(12.0, 40.0)
        if overtaking:
            self._plan_passing(luck(seed, 34))
        # the one in the camera's lane keeps its distance, until it drives away
        gap, leaves = rng.uniform(9.0, 14.0), rng.uniform(0.4, 0.8) * len(drive.sample)
        away = np.maximum(np.arange(len(drive.sample)) - leaves, 0.0)
        self._courses.insert(0, (drive.sample + (gap + 0.5 * away) / STEP, 0.0, 1.0))
        self._cars = things(rng, [car] * len(self._courses))

    def _beside_at(self, frame: float, speed: float) -> FloatArray:
        """Lane samples of a steady car that is beside the camera at a frame."""
        sample = self._route.sample
        return sample[int(frame)] + speed * (np.arange(len(sample)) - frame)

    def _plan_passing(self, rng: np.random.Generator) -> None:
        """Courses of cars on the camera's left, and of slower ones on its right."""
        frames = len(self._route.sample)
        for _ in range(max(1, frames // 12)):
            beside = int(rng.integers(frames))
            left = rng.random() < 0.75
            speed = (rng.uniform(1.15, 1.9) if left else rng.uniform(0.2, 0.8)) / STEP
            lanes = rng.uniform(1.5, 2.1) if left else rng.uniform(-1.1, -0.9)
            left_m = min(self._route.lane_offset_m, WIDEST_LANE_M) * lanes
            self._courses.append((self._beside_at(beside, speed), left_m, 1.0))

    def placed(self, index: int) -> list[Mesh]:
        """The cars within sight at a frame, in the street frame."""
        camera = self._route.T_street_camera[index, :3, 3]
        seen = []
        for mesh, (samples, left_m, way) in zip(self._cars, self._courses, strict=True):
            T_street_car = self._at(samples[index], left_m, way)
            # nearer only where the drive crosses itself
            if T_street_car is not None and (
                2.6 < np.linalg.norm(T_street_car[:3, 3] - camera) < 120.0
            ):
                seen.append(mesh.placed(T_street_car))
        return seen

    def _at(self, sample: float, left_m: float, sense: float) -> FloatArray | None:
        """``T_street_car`` at a lane sample, beside the lane; None beyond its ends."""
        lane = self._route.lane_street
        k = int(np.floor(sample))
        if not 2 <= k < len(lane) - 3:
            return None
        ahead = sense * (lane[k + 2] - lane[k - 2])
        ahead /= np.linalg.norm(ahead)
        left = np.cross([0.0, 0.0, 1.0], ahead)
        left /= np.linalg.norm(left)
        position = lane[k] + (sample - k) * (lane[k + 1] - lane[k]) + sense * left_m * left
        return se3.make(np.stack([ahead, left, np.cross(ahead, left)], axis=1), position)
