"""A minimal KITTI raw drive: level LiDAR, camera without tilt, a wall of known depth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

DRIVE = "2011_09_26_drive_0099"
FOCAL, CX, CY = 60.0, 48.0, 32.0


def _points_at(places: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float32]:
    """Scans ``(N, 4)`` of points that fall on pixels ``(N, 2)`` (u, v), counted from one, at depth z."""
    x, y = (places[:, 0] - CX) / FOCAL * z, (places[:, 1] - CY) / FOCAL * z
    return np.stack([z, -x, -y, np.full_like(z, 0.5)], axis=1).astype(
        np.float32
    )  # forward, left, up, reflectance


@pytest.fixture
def points_at() -> Callable[..., NDArray[np.float32]]:
    return _points_at


@pytest.fixture
def write_drive() -> Callable[..., Path]:
    def write(root: Path, speed: float = 10.0, points: NDArray[np.float32] | None = None) -> Path:
        height, width, frames = 64, 96, 9
        date, drive = root / "2011_09_26", root / "2011_09_26" / f"{DRIVE}_sync"
        for folder in ("image_02", "velodyne_points", "oxts"):
            (drive / folder / "data").mkdir(parents=True)
        row = f"{FOCAL} 0 {CX} 0 0 {FOCAL} {CY} 0 0 0 1 0"
        identity = "1 0 0 0 1 0 0 0 1"
        (date / "calib_cam_to_cam.txt").write_text(
            f"calib_time: 09-Jan-2012 13:57:47\nR_rect_00: {identity}\nS_rect_02: {width} {height}\nP_rect_02: {row}\n"
        )
        (date / "calib_velo_to_cam.txt").write_text(
            "calib_time: x\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n"
        )
        if points is None:
            v, u = np.mgrid[1 : height + 1, 1 : width + 1]
            points = _points_at(
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

    return write
