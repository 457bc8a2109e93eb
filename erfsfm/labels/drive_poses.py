"""Poses of a training drive by the SLAM system of this installation, as a command of its own.

The networks' package does not import the SLAM system: what goes between them are a folder of images and a trajectory.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from erfsfm.common.errors import TrainingError
from erfsfm.common.processes import slam_process
from erfsfm.common.readers.pinhole import Pinhole

FPS = 10.0
CAMERA_HEIGHT_M = 1.65  # any: poses are given in camera heights
TRAJECTORY = "trajectory_optimised.kitti.txt"
SETTINGS = ("mapping.enabled=false", "output.report=false")


def drive_poses(
    name: str, images: Iterable[Path | NDArray[np.uint8]], camera: Pinhole, weights: str
) -> NDArray[np.float64]:
    """Run the SLAM system on a drive; ``TrainingError`` where it gives no trajectory or no scale.

    Args:
        name: of the drive, for errors.
        images: of every frame, files or RGB ``(H, W, 3)``.
        camera: of the images.
        weights: of the networks that the system uses.

    Returns:
        ``T_world_camera`` ``(N, 4, 4)``, translations in heights of the camera over the road.
    """
    with tempfile.TemporaryDirectory(prefix="erfsfm-teacher-") as temporary:
        drive, output = Path(temporary) / "drive", Path(temporary) / "run"
        drive.mkdir()
        for index, image in enumerate(images):
            place = drive / f"{index:06d}.png"
            if isinstance(image, Path):
                place.with_suffix(image.suffix).symlink_to(image.resolve())
            else:
                cv2.imwrite(str(place), image[..., ::-1])
        numbers = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
        (drive / "camera.yaml").write_text(yaml.safe_dump(numbers | {"fps": FPS, "camera_height_m": CAMERA_HEIGHT_M}))
        words = ["run", "--dataset", str(drive), "--output", str(output), "--weights", weights, "--device", "cpu"]
        reason = slam_process([*words, *(word for setting in SETTINGS for word in ("--set", setting))])
        if reason or not (output / TRAJECTORY).is_file():
            raise TrainingError(f"the teacher's poses of {name} could not be found: {reason or 'it wrote none'}")
        rows = np.loadtxt(output / TRAJECTORY).reshape(-1, 3, 4)
        mode = json.loads((output / "metrics.json").read_text())["scale"]["mode"]
    if mode != "camera-height":
        raise TrainingError(f"the teacher's poses of {name} have no scale: no road was found (scale mode {mode})")
    T_world_camera = np.tile(np.eye(4), (len(rows), 1, 1))
    T_world_camera[:, :3] = rows
    T_world_camera[:, :3, 3] /= CAMERA_HEIGHT_M
    return T_world_camera
