"""Poses of a training drive by the SLAM system of this installation, as a command of its own.

The networks' package does not import the SLAM system: what goes between them are a folder of images and a trajectory.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from pathlib import Path

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
    name: str, count: int, camera: Pinhole, put_image: Callable[[int, Path], Path], weights: str
) -> NDArray[np.float64]:
    """Run the SLAM system on a drive.

    Args:
        name: of the drive, for errors.
        count: number of frames.
        camera: of the images.
        put_image: makes the image of a frame appear at the path given without suffix, and returns the file.
        weights: of the networks that the system uses.

    Returns:
        ``T_world_camera`` ``(count, 4, 4)``, translations in heights of the camera over the road.

    Raises:
        TrainingError: the system could not be started or gives no trajectory for this drive.
    """
    with tempfile.TemporaryDirectory(prefix="erfsfm-teacher-") as temporary:
        drive, output = Path(temporary) / "drive", Path(temporary) / "run"
        drive.mkdir()
        for index in range(count):
            put_image(index, drive / f"{index:06d}")
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
