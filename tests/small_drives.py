"""Small drives on disk.

One is towards a textured plane, with exact images, depth and poses; the other has LiDAR and GPS.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.geometry import Camera

RNG = np.random.default_rng(0)
WAVES = RNG.uniform(-1.0, 1.0, (12, 2)) * 4.0
PHASES = RNG.uniform(0, 2 * np.pi, (12, 3))
DRIVE = "2011_09_26_drive_0099"
FOCAL, CX, CY = 60.0, 48.0, 32.0  # of the drive with LiDAR, pixels


@dataclass(frozen=True)
class Plane:
    """A plane z = ``distance`` in the first camera's frame, painted with smooth waves, at rest."""

    camera: Camera
    distance: float = 4.0

    def points(self, t_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where each pixel's ray meets the plane ``(H, W, 2)``; the camera never rotates."""
        v, u = np.mgrid[: self.camera.height, : self.camera.width].astype(np.float64)
        depth = self.distance - t_world_camera[2]
        x = (u - self.camera.cx) / self.camera.fx * depth + t_world_camera[0]
        y = (v - self.camera.cy) / self.camera.fy * depth + t_world_camera[1]
        return np.stack([x, y], axis=-1)

    def colours(self, t_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """The image ``(H, W, 3)`` in [0, 1]."""
        angles = self.points(t_world_camera) @ WAVES.T  # (H, W, 12)
        waves = np.cos(np.float32(angles[..., None] + PHASES)).mean(
            axis=2, dtype=float
        )  # (H, W, 3)
        return 0.5 + 0.4 * np.clip(waves * 2, -1, 1)

    def image(self, t_world_camera: NDArray[np.float64]) -> NDArray[np.uint8]:
        """The image ``(H, W, 3)`` uint8 RGB."""
        return np.rint(self.colours(t_world_camera) * 255).astype(np.uint8)


def write_root(
    root: Path,
    frames: int = 8,
    sequences: tuple[str, ...] = ("00",),
    cameras: tuple[str, ...] = ("image_2",),
    suffix: str = ".png",
    seed: int | None = None,
    depth: bool = False,
    size: tuple[int, int] = (64, 96),
    step: tuple[float, float, float] = (0.05, 0.0, 0.1),
) -> Path:
    """A KITTI odometry root of a drive towards the plane."""
    scene = Plane(Camera(size[1], size[0], 60.0, 62.0, (size[1] - 1) / 2, (size[0] - 1) / 2), 6.0)
    camera = scene.camera
    row = f"{camera.fx} 0 {camera.cx} 0 0 {camera.fy} {camera.cy} 0 0 0 1 0"
    for sequence in sequences:
        home = root / "sequences" / sequence
        home.mkdir(parents=True)
        (home / "calib.txt").write_text("".join(f"P{k}: {row}\n" for k in range(4)))
        (home / "times.txt").write_text("".join(f"{0.1 * k}\n" for k in range(frames)))
        (root / "poses").mkdir(exist_ok=True)
        places = np.arange(frames)[:, None] * np.array(step)
        lines = [f"1 0 0 {x} 0 1 0 {y} 0 0 1 {z}\n" for x, y, z in places]
        (root / "poses" / f"{sequence}.txt").write_text("".join(lines))
        for folder in cameras:
            (home / folder).mkdir()
            for index, place in enumerate(places):
                image = scene.image(place + int(sequence) * 0.3)
                cv2.imwrite(str(home / folder / f"{index:06d}{suffix}"), image[..., ::-1])
        if depth:
            (home / "depth_2").mkdir()
            for index, place in enumerate(places):
                encoded = np.full(size, (scene.distance - place[2]) * 256, dtype=np.uint16)
                cv2.imwrite(str(home / "depth_2" / f"{index:06d}.png"), encoded)
    if seed is not None:
        (root / "simulation.json").write_text(json.dumps({"seed": seed}))
    return root


def points_at(places: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float32]:
    """Scans ``(N, 4)`` of points at depth z that fall on pixels ``(N, 2)`` (u, v), counted from one."""
    x, y = (places[:, 0] - CX) / FOCAL * z, (places[:, 1] - CY) / FOCAL * z
    return np.stack([z, -x, -y, np.full_like(z, 0.5)], axis=1).astype(
        np.float32
    )  # forward, left, up, reflectance


def write_drive(root: Path, speed: float = 10.0, points: NDArray[np.float32] | None = None) -> Path:
    """A KITTI raw drive: level LiDAR, camera without tilt, a wall of known depth."""
    height, width, frames = 64, 96, 9
    date, drive = root / "2011_09_26", root / "2011_09_26" / f"{DRIVE}_sync"
    for folder in ("image_02", "velodyne_points", "oxts"):
        (drive / folder / "data").mkdir(parents=True)
    row = f"{FOCAL} 0 {CX} 0 0 {FOCAL} {CY} 0 0 0 1 0"
    identity = "1 0 0 0 1 0 0 0 1"
    (date / "calib_cam_to_cam.txt").write_text(
        f"calib_time: 09-Jan-2012 13:57:47\nR_rect_00: {identity}\nS_rect_02: {width} {height}\nP_rect_02: {row}\n"
    )
    (date / "calib_velo_to_cam.txt").write_text("calib_time: x\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")
    if points is None:
        v, u = np.mgrid[1 : height + 1, 1 : width + 1]
        points = points_at(
            np.stack([u.ravel(), v.ravel()], axis=1).astype(float), np.full(u.size, 20.0)
        )
    stamps = [f"2011-09-26 13:10:51.{100_000_000 * k:09d}" for k in range(frames)]
    (drive / "oxts" / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    for k in range(frames):
        image = np.full((height, width, 3), 40 + 10 * k, np.uint8)
        cv2.imwrite(str(drive / "image_02/data" / f"{k:010d}.png"), image)
        points.tofile(drive / "velodyne_points/data" / f"{k:010d}.bin")
        values = np.zeros(30)
        values[[6, 7, 10]] = [0.6 * speed, 0.8 * speed, 0]
        (drive / "oxts/data" / f"{k:010d}.txt").write_text(" ".join(f"{v:g}" for v in values))
    return root
