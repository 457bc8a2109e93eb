"""Tiny data sets written to a temporary folder; image k is a flat grey of value 10 k."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

WIDTH, HEIGHT = 40, 24
CAMERA_YAML = "width: 40\nheight: 24\nfx: 30\nfy: 30\ncx: 20\ncy: 12\nfps: 5\n"

# fx, fy = 30, camera 2 sits 0.06 m left of camera 0 and camera 3 0.47 m right: p4 = K t
CALIB = """P0: 30 0 20 0 0 30 12 0 0 0 1 0
P1: 30 0 20 -15 0 30 12 0 0 0 1 0
P2: 30 0 20 1.8 0 30 12 0 0 0 1 0
P3: 30 0 20 -14.1 0 30 12 0 0 0 1 0
Tr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3
"""


def write_images(folder: Path, names: list[str], width: int = WIDTH, height: int = HEIGHT) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((height, width, 3), 10 * index, np.uint8))


def write_poses(path: Path, frames: int) -> None:
    """Camera 0 drives 1 m a frame along x of a world that is turned by 90 degrees about y."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"0 0 1 {5 + k} 0 1 0 2 -1 0 0 3\n" for k in range(frames)))


def write_odometry_sequence(
    base: Path,
    name: str = "00",
    frames: int = 6,
    camera: int = 2,
    suffix: str = ".png",
    poses: bool = True,
) -> Path:
    folder = base / "sequences" / name
    write_images(folder / f"image_{camera}", [f"{k:06d}{suffix}" for k in range(frames)])
    (folder / "calib.txt").write_text(CALIB)
    (folder / "times.txt").write_text("".join(f"{0.1 * k:e}\n" for k in range(frames)))
    if poses:
        write_poses(base / "poses" / f"{name}.txt", frames)
    return folder


OdometryWriter = Callable[..., Path]


@pytest.fixture
def odometry() -> OdometryWriter:
    return write_odometry_sequence


@pytest.fixture
def images() -> Callable[..., None]:
    return write_images


@pytest.fixture
def camera_yaml() -> str:
    return CAMERA_YAML


@pytest.fixture(autouse=True)
def no_kitti_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KITTI_ODOMETRY", raising=False)
