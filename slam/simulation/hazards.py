"""Hazards of a simulated drive: moving cars, exposure jumps, motion blur, a stop, rain."""

from typing import Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from slam.geometry import se3
from slam.simulation.geometry import Float32Array, FloatArray, Mesh, Moving
from slam.simulation.objects import car, frame_at
from slam.simulation.route import STEP, Route

Hazard = Literal["moving-cars", "exposure", "blur", "stop", "rain"]

STILL_FRAMES = 30  # 3 s at 10 frames a second
SHUTTER = 0.5  # exposure time of a blurred image over the frame interval
BLUR_SAMPLES = 6
WIDEST_LANE_M = 2.0  # from its middle to its edge


def exposure_curve(seed: int, frames: int) -> FloatArray:
    """Gain and gamma of every frame ``(N, 2)``, piecewise constant."""
    rng = np.random.default_rng([seed, 31])
    curve = np.empty((frames, 2))
    start = 0
    while start < frames:
        stop = start + int(rng.integers(12, 45))
        curve[start:stop] = rng.uniform(0.55, 1.5), rng.uniform(0.75, 1.3)
        start = stop
    return curve


def exposed(rgb: Float32Array, gain: float, gamma: float) -> Float32Array:
    """An image about [0, 1] under another exposure."""
    return np.asarray(gain * np.power(np.clip(rgb, 0.0, 1.0), gamma), dtype=np.float32)


def rained_on(rgb: Float32Array, seed: int, index: int) -> Float32Array:
    """Rain streaks and reduced contrast over an image ``(H, W, 3)`` about [0, 1]."""
    rng = np.random.default_rng([seed, 32, index])
    height, width = rgb.shape[:2]
    drops = (rng.random((height, width)) < 0.005).astype(np.float32) * rng.uniform(0.4, 1.0)
    length = max(3, height // 11)
    kernel = np.zeros((length, length), dtype=np.float32)
    slant = float(rng.uniform(-0.3, 0.3))
    for row in range(length):
        kernel[row, int(length / 2 + slant * (row - length / 2))] = 1.0
    streaks = np.clip(cv2.filter2D(drops, -1, kernel), 0.0, 1.0)[..., None] * 0.4
    veiled = rgb * 0.85 + 0.07
    return np.asarray(veiled + streaks * (0.85 - veiled), dtype=np.float32)


def sensed(rgb: Float32Array, vignette: float, noise: float, seed: int, index: int) -> Float32Array:
    """An image ``(H, W, 3)`` that lacks a share of light in its corners, under noise of a deviation."""
    y, x = (np.linspace(-1.0, 1.0, side, dtype=np.float32) for side in rgb.shape[:2])
    falloff = 1.0 - np.float32(0.5 * vignette) * (x * x + (y * y)[:, None])
    grain = np.random.default_rng([seed, 35, index]).standard_normal(rgb.shape, dtype=np.float32)
    return np.asarray(rgb * falloff[..., None] + np.float32(noise) * grain)


def shutter_poses(T_street_camera: FloatArray, index: int) -> FloatArray:
    """Poses while the shutter is open around a frame, ``(BLUR_SAMPLES, 4, 4)``; all one pose at a stop."""
    low, high = max(index - 1, 0), min(index + 1, len(T_street_camera) - 1)
    here = T_street_camera[index]
    T_low_high = se3.invert(T_street_camera[low]) @ T_street_camera[high]
    turn = Rotation.from_matrix(T_low_high[:3, :3]).as_rotvec()
    if np.array_equal(here, T_street_camera[high]):
        return np.repeat(here[None], BLUR_SAMPLES, axis=0)
    fraction = (np.arange(BLUR_SAMPLES) + 0.5) / BLUR_SAMPLES - 0.5
    fraction *= SHUTTER / (high - low)
    T_here_shutter = se3.from_rotation_vector(fraction[:, None] * turn, fraction[:, None] * T_low_high[:3, 3])
    return np.asarray(here @ T_here_shutter)


class Traffic:
    """Moving cars: one ahead of the camera for a while, others oncoming; some overtake it if wanted."""

    def __init__(self, drive: Route, seed: int, overtaking: bool = False) -> None:
        rng = np.random.default_rng([seed, 33])
        self._route = drive
        # offset in lane samples, per frame, to the left in metres, along the lane or against it
        self._courses: list[tuple[float, float, float, float]] = []
        meets = float(rng.uniform(4.0, 15.0))
        while meets < len(drive.sample):
            speed = -float(rng.uniform(0.7, 1.2)) / STEP
            start = float(drive.sample[int(meets)]) - speed * meets
            self._courses.append((start, speed, 2.0 * drive.lane_offset_m + float(rng.uniform(0.0, 0.3)), -1.0))
            meets += float(rng.uniform(12.0, 40.0))
        if overtaking:
            self._courses += self._plan_passing(np.random.default_rng([seed, 34]))
        self._gap = float(rng.uniform(9.0, 14.0)) / STEP
        self._leader_leaves = float(rng.uniform(0.4, 0.8)) * len(drive.sample)
        makers = [lambda soup: car(soup, rng, frame_at(0.0, 0.0, 0.0))] * (1 + len(self._courses))
        self._cars = Moving(rng, makers)

    def _plan_passing(self, rng: np.random.Generator) -> list[tuple[float, float, float, float]]:
        """Courses of cars on the camera's left, and of slower ones on its right."""
        passing = []
        for _ in range(max(1, len(self._route.sample) // 12)):
            beside = int(rng.integers(len(self._route.sample)))
            left = rng.random() < 0.75
            speed = float(rng.uniform(1.15, 1.9) if left else rng.uniform(0.2, 0.8)) / STEP
            lanes = float(rng.uniform(1.5, 2.1) if left else rng.uniform(-1.1, -0.9))
            left_m = min(self._route.lane_offset_m, WIDEST_LANE_M) * lanes
            passing.append((float(self._route.sample[beside]) - speed * beside, speed, left_m, 1.0))
        return passing

    def placed(self, index: int) -> list[Mesh]:
        """The cars within sight at a frame, in the street frame."""
        camera = self._route.T_street_camera[index, :3, 3]
        # the one in the camera's lane keeps its distance, until it drives away
        faster = max(0.0, index - self._leader_leaves) * 0.5 / STEP
        T_street_cars = [self._at(float(self._route.sample[index]) + self._gap + faster, 0.0, 1.0)]
        T_street_cars += [self._at(start + speed * index, left_m, way) for start, speed, left_m, way in self._courses]
        there = {number: T_street_car for number, T_street_car in enumerate(T_street_cars) if T_street_car is not None}
        away = {number: np.linalg.norm(T_street_car[:3, 3] - camera) for number, T_street_car in there.items()}
        # nearer only where the drive crosses itself
        return self._cars.placed({number: there[number] for number in there if 2.6 < away[number] < 120.0})

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
