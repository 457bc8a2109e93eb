"""A textured plane seen by a moving camera: exact images, depth and poses for every test of the networks."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from erfsfm.config import ExperimentConfig
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.data.recordings import Recording
from erfsfm.data.split import split_recordings
from erfsfm.geometry import Camera

RNG = np.random.default_rng(0)
WAVES = RNG.uniform(-1.0, 1.0, (12, 2)) * 4.0
PHASES = RNG.uniform(0, 2 * np.pi, (12, 3))


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
        waves = np.cos(angles[..., None] + PHASES).mean(axis=2)  # (H, W, 3)
        return 0.5 + 0.4 * np.clip(waves * 2, -1, 1)

    def image(self, t_world_camera: NDArray[np.float64]) -> NDArray[np.uint8]:
        """The image ``(H, W, 3)`` uint8 RGB."""
        return np.rint(self.colours(t_world_camera) * 255).astype(np.uint8)


@pytest.fixture(autouse=True)
def _seeded_torch() -> None:
    torch.manual_seed(0)
    cv2.setNumThreads(1)  # forked workers do not inherit OpenCV's threads


@pytest.fixture
def plane() -> Plane:
    return Plane(Camera(width=96, height=64, fx=60.0, fy=62.0, cx=47.0, cy=30.0))


WriteRoot = Callable[..., Path]


@pytest.fixture
def write_root() -> WriteRoot:
    """Writes a KITTI odometry root of a drive towards the plane."""

    def write(
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
        scene = Plane(
            Camera(size[1], size[0], 60.0, 62.0, (size[1] - 1) / 2, (size[0] - 1) / 2), 6.0
        )
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

    return write


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
