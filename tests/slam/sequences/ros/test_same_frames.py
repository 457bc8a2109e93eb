"""The same frames as a bag, as a EuRoC folder and as a plain folder are the same sequence, byte for byte."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from erfsfm.common.readers.camera_file import CameraFile, Pinhole, read_camera_file
from slam.sequences.catalogue import open_sequence

FIRST_NS, STEP_NS, FRAMES = 1403715273262142976, 100_000_000, 8
BENT = (-0.02, 0.001, 0.0, 0.0)


def write_plain(folder: Path, files: list[Path], stamps: list[int], camera: CameraFile) -> Path:
    folder.mkdir()
    for path in files:
        shutil.copy(path, folder)
    (folder / "times.txt").write_text("".join(f"{s // 10**9}.{s % 10**9:09d}\n" for s in stamps))
    (folder / "camera.yaml").write_text(json.dumps(camera.model_dump(exclude_none=True)))
    return folder


def write_euroc(folder: Path, files: list[Path], stamps: list[int], camera: CameraFile) -> Path:
    data = folder / "mav0/cam0/data"
    data.mkdir(parents=True)
    for path, stamp in zip(files, stamps, strict=True):
        shutil.copy(path, data / f"{stamp}.png")
    (data.parent / "data.csv").write_text(
        "#timestamp,filename\n" + "".join(f"{s},{s}.png\n" for s in stamps)
    )
    sensor = {
        "T_BS": {"data": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
        "rate_hz": 10,
        "resolution": [camera.width, camera.height],
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion_model": "radtan",
        "distortion_coefficients": list(BENT),
    }
    (data.parent / "sensor.yaml").write_text("%YAML:1.0\n" + json.dumps(sensor))
    return folder


def write_bag(bag: Any, files: list[Path], stamps: list[int], camera: CameraFile) -> Path:
    bag.camera_info("/camera/camera_info", camera.pinhole, "plumb_bob", BENT)
    for path, stamp in zip(files, stamps, strict=True):
        bag.image("/camera/image_raw", stamp, cv2.imread(str(path)), "bgr8", late_ns=3_000_000)
    made: Path = bag.close()
    return made


def test_the_same_frames_are_the_same_sequence(
    tmp_path: Path, kitti_root: Path, new_bag: Callable[..., Any]
) -> None:
    files = sorted((kitti_root / "sequences/sim/image_2").iterdir())[:FRAMES]
    stamps = [FIRST_NS + k * STEP_NS for k in range(FRAMES)]
    simulated = open_sequence(kitti_root).intrinsics
    known = read_camera_file(kitti_root / "camera.yaml").model_dump() | vars(Pinhole.of(simulated))
    camera = CameraFile.model_validate(
        known | {"model": "opencv", "distortion": BENT, "camera_height_m": "unknown"}
    )
    plain, *others = map(
        open_sequence,
        (
            write_plain(tmp_path / "plain", files, stamps, camera),
            write_euroc(tmp_path / "euroc", files, stamps, camera),
            write_bag(new_bag("ros1", "one"), files, stamps, camera),
            write_bag(new_bag("sqlite", "two"), files, stamps, camera),
        ),
    )
    assert plain.intrinsics.undistorted and plain.stamps[0] == pytest.approx(
        FIRST_NS / 1e9, abs=1e-6
    )
    for other in others:
        assert other.intrinsics == plain.intrinsics and other.camera_height_m is None
        np.testing.assert_array_equal(other.stamps, plain.stamps)
        for k in range(FRAMES):
            np.testing.assert_array_equal(other.frame(k).image, plain.frame(k).image)
