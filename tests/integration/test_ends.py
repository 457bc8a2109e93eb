"""Whatever is recorded, a run ends with a pose for every frame: cameras, rates, ways and disturbances by chance."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from erfsfm.common.errors import SHOW_TRACEBACK
from slam import run_slam
from slam.commands.live import LiveRequest, run_live
from slam.formats.trajectory import read_trajectory
from slam.geometry.se3 import is_se3
from slam.results.folder import RunFolder
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import simulated_world

SIZES = ((160, 120), (320, 240), (416, 128), (640, 480), (1280, 720), (1920, 1080))
WAYS = ("walk", "look", "phone", "drone", "robot", "robot", "straight", "loop", "stands", "turn")
DISTURBANCES = ("none", "none", "none", "black", "frozen", "elsewhere", "again", "noise", "dark")
MOST_RENDERED = 320  # columns: larger images are enlarged


@dataclass(frozen=True)
class Recording:
    """One draw."""

    seed: int
    way: str
    size: tuple[int, int]
    fov_deg: float
    fps: float
    frames: int
    disturbance: str
    height_m: float | None
    overrides: tuple[str, ...]

    @classmethod
    def of(cls, seed: int, most_frames: int = 60) -> Recording:
        """The recording of a seed."""
        rng = np.random.default_rng([seed, 77])
        size, way = (
            SIZES[rng.choice(6, p=(0.3, 0.3, 0.15, 0.15, 0.05, 0.05))],
            str(rng.choice(WAYS)),
        )
        fov_deg, fps = (
            float(rng.uniform(40.0, 130.0)),
            float(np.exp(rng.uniform(0.0, np.log(60.0)))),
        )
        frames, disturbance = int(rng.integers(8, most_frames + 1)), str(rng.choice(DISTURBANCES))
        height_m = float(rng.uniform(0.3, 2.0)) if rng.random() < 0.4 else None
        overrides = [f"mapping.enabled={str(rng.random() < 0.3).lower()}", "output.report=false"]
        overrides.append(
            f"keyframes.use={rng.choice(['always', 'auto', 'never'], p=(0.5, 0.4, 0.1))}"
        )
        return cls(
            seed,
            way,
            size,
            round(fov_deg, 1),
            round(fps, 2),
            frames,
            disturbance,
            height_m,
            tuple(overrides),
        )

    def write(self, folder: Path) -> None:
        """A folder of images and their ``camera.yaml``."""
        width, height = self.size
        focal = 0.5 * width / np.tan(0.5 * np.deg2rad(self.fov_deg))
        camera = {"width": width, "height": height, "fx": focal, "fy": focal, "fps": self.fps}
        camera |= {
            "cx": 0.5 * (width - 1),
            "cy": 0.5 * (height - 1),
            "camera_height_m": self.height_m or "unknown",
        }
        folder.mkdir()
        (folder / "camera.yaml").write_text(
            "".join(f"{key}: {value}\n" for key, value in camera.items())
        )
        for k, image in enumerate(self.disturbed()):
            cv2.imwrite(
                str(folder / f"{k:06d}.png"),
                cv2.resize(image, self.size, interpolation=cv2.INTER_LINEAR),
            )

    def disturbed(self) -> list[np.ndarray]:
        """The images, some after the first five black, frozen, of another place or one seen before, noisy or dark."""
        rng, images = np.random.default_rng([self.seed, 78]), self.images()
        first = int(rng.integers(5, self.frames))
        last = min(first + int(rng.integers(1, 25)), self.frames)
        for k in range(first, last):
            if self.disturbance == "black":
                images[k] = np.zeros_like(images[k])
            elif self.disturbance == "frozen":
                images[k] = images[first - 1]
            elif self.disturbance == "elsewhere":
                images[k] = np.ascontiguousarray(images[self.frames - 1 - k][:, ::-1])
            elif self.disturbance == "again":
                images[k] = images[(5 * k) % first]
            elif self.disturbance == "noise":
                images[k] = rng.integers(0, 256, images[k].shape, np.uint8)
            elif self.disturbance == "dark":
                images[k] = images[k] // 12
        return images

    def images(self) -> list[np.ndarray]:
        """Rendered, or one rendered image again and again, as a camera sees it that stands."""
        width = min(self.size[0], MOST_RENDERED)
        height = round(self.size[1] * width / self.size[0])
        is_street = self.way in ("straight", "loop")
        # the simulator has 5 to 60 frames a second: slower ones are some of these
        stride = 1 if is_street else max(round(5.0 / self.fps + 0.49), 1)
        count = max(self.frames * stride, 250 if self.way == "loop" else 0)
        motion = self.way if self.way not in ("straight", "loop", "stands") else None
        options = SimulationOptions(
            self.way if is_street else "rooms",
            count,
            self.seed,
            width,
            height,
            motion=motion,
            rate=10.0 if is_street else float(np.clip(self.fps * stride, 5.0, 60.0)),
            fov_deg=self.fov_deg,
        )
        world = simulated_world(options)
        if self.way != "stands":
            return [
                cv2.cvtColor(world.render(k * stride), cv2.COLOR_RGB2BGR)
                for k in range(self.frames)
            ]
        still, rng = world.render(0)[:, :, ::-1], np.random.default_rng([self.seed, 79])
        noise = rng.normal(0.0, 2.0, (self.frames, *still.shape))
        return list(np.clip(still + noise, 0, 255).astype(np.uint8))


def check(recording: Recording, run: RunFolder) -> None:
    """Every frame has a finite pose, and no stage failed."""
    for name in ("network", "odometry", "optimised"):
        trajectory = read_trajectory(run.path / f"trajectory_{name}.kitti.txt")
        assert len(trajectory) == recording.frames
        assert is_se3(trajectory.T_world_camera)
    metrics = run.metrics()
    assert metrics.status == "ok"
    assert metrics.graph.nodes == recording.frames


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(28))
def test_a_run_ends(seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A failed stage, too, is an error here; the last ones are streams."""
    monkeypatch.setenv(SHOW_TRACEBACK, "1")
    recording, images, output = Recording.of(seed), tmp_path / "images", tmp_path / "run"
    recording.write(images)
    if seed < 24:
        check(recording, run_slam(images, output=output, overrides=recording.overrides))
        return
    options = {"every_frame": True, "wait": 1.0, "overrides": list(recording.overrides)}
    check(recording, run_live(LiveRequest(dataset=str(images), output=output, **options), print))
