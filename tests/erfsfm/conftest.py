"""Small drives and experiments for every test of the networks."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import small_drives
import torch
from small_drives import Plane

from erfsfm.config import ExperimentConfig
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.data.recordings import Recording
from erfsfm.data.split import split_recordings
from erfsfm.geometry import Camera


@pytest.fixture(autouse=True)
def _seeded_torch() -> None:
    torch.manual_seed(0)
    cv2.setNumThreads(1)  # forked workers do not inherit OpenCV's threads


@pytest.fixture
def plane() -> Plane:
    return Plane(Camera(width=96, height=64, fx=60.0, fy=62.0, cx=47.0, cy=30.0))


@pytest.fixture
def write_root() -> Callable[..., Path]:
    """Writes a KITTI odometry root of a drive towards the plane."""
    return small_drives.write_root


@pytest.fixture
def write_raw() -> Callable[..., Path]:
    """Writes a KITTI raw drive with both colour cameras, and packets of the GPS/IMU where speeds are given."""

    def write(
        root: Path,
        drive: str = "2011_09_26_drive_0001",
        frames: int = 6,
        size: tuple[int, int] = (64, 96),
        stored: tuple[int, int] | None = None,
        speeds: list[float] | None = None,
    ) -> Path:
        home = root / drive[:10] / f"{drive}_sync"
        height, width = size
        rows = [
            f"S_rect_{camera}: {width} {height}\nP_rect_{camera}: 60 0 {cx} 0 0 62 {height // 2 - 2} 0 0 0 1 0\n"
            for camera, cx in (
                ("00", width // 2 - 1),
                ("02", width // 2 - 1),
                ("03", width // 2 - 2),
            )
        ]
        scene = Plane(Camera(width, height, 60.0, 62.0, 47.0, 30.0), 6.0)
        for camera in ("image_02", "image_03"):
            (home / camera / "data").mkdir(parents=True)
            for index in range(len(speeds) if speeds else frames):
                image = scene.image(np.array([0.05, 0, 0.1]) * index)
                shrunken = cv2.resize(image, (stored or size)[::-1], interpolation=cv2.INTER_AREA)
                cv2.imwrite(str(home / camera / "data" / f"{index:010d}.png"), shrunken[..., ::-1])
        (home.parent / "calib_cam_to_cam.txt").write_text(
            "calib_time: 09-Jan-2012 13:57:47\n" + "".join(rows)
        )
        for index, speed in enumerate(speeds or []):
            (home / "oxts" / "data").mkdir(parents=True, exist_ok=True)
            packet = np.zeros(30)
            packet[[6, 7]] = 0.6 * speed, 0.8 * speed
            (home / "oxts/data" / f"{index:010d}.txt").write_text(
                " ".join(f"{number:g}" for number in packet)
            )
        return home

    return write


# rows of the paper's tables that differ in the size of images alone count once
_CONFIGURATIONS = {
    re.sub(r"-\d+x\d+$", "", path.stem): path.stem
    for path in sorted((Path(__file__).parents[2] / "configs" / "erfsfm").glob("*.yaml"))
}


@pytest.fixture(
    params=[
        # a row of table 3 has both networks of the paper
        pytest.param(
            name,
            marks=pytest.mark.slow if re.match("table[12]|erf-|default-(gpu|pose)", name) else (),
        )
        for name in _CONFIGURATIONS.values()
    ]
)
def configuration(request: pytest.FixtureRequest) -> str:
    """The name of a shipped configuration; each kind of networks and settings comes once."""
    return str(request.param)


@pytest.fixture
def small() -> dict[str, dict[str, object]]:
    """Settings of an experiment that runs in a second."""
    return {
        "network": {
            "depth_width": 0.0625,
            "pose_width": 0.125,
            "sources": 2,
            "height": 32,
            "width": 64,
        },
        "data": {"workers": 0, "validation": [], "cache_mb": 50},
        "training": {"steps": 4, "batch": 2, "checkpoint_every": 2, "validate_every": 2},
    }


@pytest.fixture(scope="session")
def measure() -> Callable[[ExperimentConfig, Callable[[Recording, int], float]], None]:
    """Keeps what a teacher by many views measures: a drive straight on, and one least inverse depth an image."""

    def keep(config: ExperimentConfig, least_of: Callable[[Recording, int], float]) -> None:
        assert config.teacher.cache is not None
        size = (config.network.height, config.network.width)
        teacher = ManyViewTeacher(config.teacher.cache, size, config.teacher.stride)
        for recording in split_recordings(config.data)[0]:
            drive = teacher.drive(recording)
            T_world_camera = np.tile(np.eye(4), (len(recording), 1, 1))
            T_world_camera[:, 2, 3] = 0.3 * np.arange(len(recording))
            drive.keep_poses(T_world_camera)
            for target in drive.targets(config.network.sources):
                least = np.full(size, least_of(recording, target), np.float16)
                drive.label_file(target).parent.mkdir(exist_ok=True)
                np.savez_compressed(drive.label_file(target), least=least, most=1.06 * least)

    return keep
