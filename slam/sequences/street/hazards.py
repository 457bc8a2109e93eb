"""What makes a drive hard: changing exposure, blur, a stop, rain and moving cars."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.sequences.street.furniture import car
from slam.sequences.street.geometry import Bend, Float32Array, FloatArray, Mesh, Soup
from slam.sequences.street.route import STEP, Drive

Hazard = Literal["moving-cars", "exposure", "blur", "stop", "rain"]
HAZARDS: tuple[str, ...] = get_args(Hazard)

STILL_FRAMES = 30  # 3 s at 10 frames a second
BLUR_SPAN, BLUR_SAMPLES = 0.6, 4  # of the frame interval the shutter is open
_FLAT = Bend(np.zeros(3), np.ones(3), np.zeros((3, 2)))


def exposure_curves(rng: np.random.Generator, frames: int) -> FloatArray:
    """Gain and gamma of each frame ``(N, 2)``, constant for a while and then jumping."""
    curves = np.empty((frames, 2))
    start = 0
    while start < frames:
        stop = start + int(rng.integers(15, 45))
        curves[start:stop] = rng.uniform(0.55, 1.5), rng.uniform(0.75, 1.3)
        start = stop
    return curves


def exposed(image: NDArray[np.float32], gain: float, gamma: float) -> NDArray[np.float32]:
    """An image in [0, 1] under another exposure."""
    return np.asarray(gain * np.power(np.clip(image, 0, 1), gamma), dtype=np.float32)


def rained_on(image: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Streaks and a veil of rain over an image ``(H, W, 3)`` in [0, 1]."""
    height, width = image.shape[:2]
    drops = (rng.random((height, width)) < 0.006).astype(np.float32)
    length = max(3, height // 12)
    kernel = np.zeros((length, length), np.float32)
    slant = int(rng.integers(-1, 2))
    for row in range(length):
        kernel[row, length // 2 + slant * (row - length // 2) // 4] = 1.0
    streaks = np.clip(cv2.filter2D(drops, -1, kernel), 0, 1)[..., None] * 0.35
    veiled = image * 0.88 + 0.06
    return np.asarray(veiled * (1 - streaks) + 0.85 * streaks, dtype=np.float32)


@dataclass(frozen=True)
class MovingCar:
    """A car that drives along the camera's path.

    Attributes:
        mesh: at the origin, facing +x.
        start: where on the path it is at frame 0, in samples of the path.
        speed: samples per frame; negative comes towards the camera.
        side: metres to the left of the camera's lane.
    """

    mesh: Mesh
    start: float
    speed: float
    side: float

    def T_street_car(self, drive: Drive, frame: float) -> FloatArray | None:
        """Where it is, ``(4, 4)``, or None beyond the ends of the path."""
        path = drive.path_street
        at = self.start + self.speed * frame
        if not 2 <= at < len(path) - 3:
            return None
        k = int(at)
        tangent = path[k + 2] - path[k - 2]
        heading = np.arctan2(tangent[1], tangent[0])
        here = path[k] + (at - k) * (path[k + 1] - path[k])
        left = np.array([-np.sin(heading), np.cos(heading), 0.0])
        yaw = heading if self.speed > 0 else heading + np.pi
        T_street_car = np.eye(4)
        T_street_car[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T_street_car[:3, 3] = here + self.side * left
        return T_street_car


def traffic(drive: Drive, rng: np.random.Generator) -> list[MovingCar]:
    """Oncoming cars now and then, and one car ahead for a part of the way."""
    cars = [MovingCar(_car_mesh(rng), drive.sample[0] + 16.0 / STEP, 1.02 * float(np.mean(np.diff(drive.sample))), 0.0)]
    frame = float(rng.uniform(5, 25))
    while frame < len(drive.sample):
        speed = -float(rng.uniform(0.7, 1.2)) / STEP
        meets = drive.sample[int(frame)]
        cars.append(MovingCar(_car_mesh(rng), meets - speed * frame, speed, 2 * drive.lane_offset + 0.2))
        frame += float(rng.uniform(15, 45))
    return cars


def placed(mesh: Mesh, T_street_car: FloatArray) -> tuple[Float32Array, Float32Array]:
    """Vertices ``(V, 3)`` and normals ``(T, 3)`` of a car's mesh in the street."""
    R = T_street_car[:3, :3].astype(np.float32)
    return mesh.vertices @ R.T + T_street_car[:3, 3].astype(np.float32), mesh.normals @ R.T


def _car_mesh(rng: np.random.Generator) -> Mesh:
    soup = Soup(rng)
    car(soup, rng, np.zeros(2), 0.0)
    return soup.finish(_FLAT)
