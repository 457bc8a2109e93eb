"""A furnished house as a world, through which a camera is carried."""

import functools

import cv2
import numpy as np

from slam.frames import Float32Array, Intrinsics
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.simulation.carried import Carried, Floor
from slam.simulation.geometry import Mesh, luck
from slam.simulation.interior import interior_of
from slam.simulation.irradiance import GLOW, irradiance_of
from slam.simulation.objects import person
from slam.simulation.options import SimulationOptions
from slam.simulation.shapes import things
from slam.simulation.world import Hits, SimulatedWorld, Surface, between, place_rays

STILL_S = 3.0
_USUAL_FOV_DEG = 65.0
_VARIED_FOV_DEG = (55.0, 100.0)
_BLUR_PX = 0.55  # of the lens, standard deviation
_PEOPLE = 6  # the first of them walks ahead of the camera
_AHEAD_S = 3.5  # by this time
_NEAREST_M = 0.7  # of a person to the camera, below which the person is left out
_GREY = 0.4  # brightness that exposure aims at
_LONGEST_S = 0.02  # exposure in the light
_MOST_OPEN = 0.9  # of the time between frames, of the shutter
_METER_S = 0.1  # the meter's period
_METERED = 12  # how often it is read
_METER_WEIGHTS = np.exp(-_METER_S * np.arange(_METERED) / 0.35)  # the newest reading first


class SimulatedRooms(SimulatedWorld):
    """A house and a walk through it; the attributes are those of `SimulatedWorld`."""

    def __init__(self, options: SimulationOptions) -> None:
        """Plan the house and the walk."""
        self.options, self._interior = options, interior_of(options.seed)
        floor = Floor(self._interior, options.seed)
        seconds = options.frames / options.rate + _AHEAD_S + 1.0
        peopled = "people" in options.hazards
        self._carried = Carried(
            floor, options.motion or "walk", seconds, options.rate, options.seed
        )
        self._walks = [
            Carried(floor, "walk", seconds, options.rate, options.seed + 1000 * k)
            for k in range(1, _PEOPLE * peopled)
        ]
        rng = luck(options.seed, 57)
        # around their own origins, looking along x
        self._people = things(rng, [person] * _PEOPLE) if peopled else []
        fov_deg, width, height = options.fov_deg or _USUAL_FOV_DEG, options.width, options.height
        if options.varied and options.fov_deg is None:
            fov_deg = np.exp(luck(options.seed, 55).uniform(*np.log(_VARIED_FOV_DEG)))
        focal_px = float(0.5 * width / np.tan(0.5 * np.deg2rad(fov_deg)))
        centre = 0.5 * (width - 1), 0.5 * (height - 1)
        camera = Intrinsics(width, height, focal_px, focal_px, *centre)
        super().__init__(options, camera, self._poses(np.arange(options.frames) / options.rate))

    @functools.cached_property
    def _still(self) -> Surface:
        return Surface(self._interior.mesh)

    @functools.cached_property
    def _irradiance(self) -> Float32Array:
        return irradiance_of(self.options.seed, "exposure" in self.options.hazards)

    def _poses(self, seconds: FloatArray) -> FloatArray:
        if "stop" in self.options.hazards:  # the camera is put down halfway
            middle = 0.5 * max(len(self) / self.options.rate - STILL_S, 0.0)
            seconds = seconds - np.clip(seconds - middle, 0.0, STILL_S)
        return self._carried.poses(seconds)

    def _shutter(self, index: int) -> tuple[float, int]:
        forward = self._T_scene_camera[max(index - 1, 0) : index + 2, :3, 2]
        turned = np.linalg.norm(np.diff(forward, axis=0), axis=1).max()
        rate = self.options.rate
        open_s = min(_LONGEST_S * self._gain(index) / self._usual_gain, _MOST_OPEN / rate)
        blurred_px = turned * open_s * rate * self.camera.fx
        return open_s, int(np.clip(blurred_px / 4.0, 3, 12))

    def _moving(self, index: int) -> list[Mesh]:
        now = index / self.options.rate
        # the first walks where the camera will be
        walkers = [(self._carried, now + _AHEAD_S), *((walk, now) for walk in self._walks)]
        camera = self._T_scene_camera[index, :2, 3]
        seen = []
        for mesh, (walk, seconds) in zip(self._people, walkers):
            T_scene_person = _standing(walk, seconds)
            if np.linalg.norm(T_scene_person[:2, 3] - camera) > _NEAREST_M:
                seen.append(mesh.placed(T_scene_person))
        return seen

    def _shade(self, hits: Hits, surfaces: list[Surface]) -> Float32Array:
        rgb = hits.unlit(self.camera.fx)
        if hits.surface is not self._still:  # people are lit as the house is in the mean
            return rgb * self._irradiance.mean() * (0.85 + 0.15 * hits.normals[2])
        light = between(np.take(self._irradiance, hits.triangle, axis=1), hits.barycentric)
        glow = GLOW[np.take(self._still.mesh.material, hits.triangle)]
        return rgb * np.where(glow > 0.0, glow, light)

    def _develop(self, rgb: Float32Array, index: int) -> Float32Array:
        """Gain, lens blur and noise."""
        gain = self._gain(index)
        rgb = cv2.GaussianBlur(rgb * np.float32(gain), (3, 3), _BLUR_PX)
        if "exposure" in self.options.hazards:
            rng = luck(self.options.seed, 56, index)
            rgb = rgb + rng.standard_normal(rgb.shape, dtype=np.float32) * np.float32(
                0.008 * np.sqrt(gain)
            )
        return rgb

    def _gain(self, index: int) -> float:
        """Of the sensor: the world's own, or one that follows the light of the last second."""
        if "exposure" not in self.options.hazards:
            return self._usual_gain
        last = int(index / self.options.rate / _METER_S)
        read = np.array([self._brightness(max(last - k, 0)) for k in range(_METERED)])
        return float(_GREY / max((read * _METER_WEIGHTS).sum() / _METER_WEIGHTS.sum(), 0.06))

    @functools.cached_property
    def _usual_gain(self) -> float:
        last = int(len(self) / self.options.rate / _METER_S)
        read = [self._brightness(int(tick)) for tick in np.linspace(0, last, _METERED)]
        return float(_GREY / np.median(read))

    @functools.lru_cache(maxsize=256)  # noqa: B019 - readings are small, worlds are kept for long
    def _brightness(self, tick: int) -> float:
        """Mean of a coarse image without people, as the camera's meter sees it."""
        (pose,) = self._poses(np.array([tick * _METER_S]))
        every = max(len(self._rays) // 400, 1)
        rays = place_rays(pose, self._rays[::every])
        rgb = self._colours([self._still], rays, self._stretch[::every])
        return float(np.minimum(rgb, 1.5).mean())


def _standing(walk: Carried, seconds: float) -> FloatArray:
    """``T_scene_person`` of whoever walks so, upright on the floor."""
    ((x, y, _, yaw, _, _),) = walk.at(np.array([seconds]))
    return se3.from_rotation_vector(np.array([0.0, 0.0, yaw]), np.array([x, y, -0.1]))
