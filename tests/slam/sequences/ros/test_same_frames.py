"""The same frames as a bag, as a EuRoC folder and as a plain folder give the same trajectories, byte for byte."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2

from erfsfm.common.readers.camera_file import CameraFile, read_camera_file
from erfsfm.common.readers.pinhole import Pinhole
from slam.commands.run.run import run_slam
from slam.sequences.catalogue import open_sequence

FIRST_NS, STEP_NS, FRAMES = 1403715273262142976, 100_000_000, 8
BENT = (-0.02, 0.001, 0.0, 0.0)
SETTINGS = ["mapping.enabled=false", "output.report=false"]


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
    (data.parent / "data.csv").write_text("#timestamp,filename\n" + "".join(f"{s},{s}.png\n" for s in stamps))
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


def test_the_same_frames_give_the_same_trajectories(
    tmp_path: Path, kitti_root: Path, tiny_weights: Path, new_bag: Callable[..., Any]
) -> None:
    files = sorted((kitti_root / "sequences/sim/image_2").iterdir())[:FRAMES]
    stamps = [FIRST_NS + k * STEP_NS for k in range(FRAMES)]
    simulated = open_sequence(kitti_root).intrinsics
    known = read_camera_file(kitti_root / "camera.yaml").model_dump() | vars(Pinhole.of(simulated))
    camera = CameraFile.model_validate(known | {"model": "opencv", "distortion": BENT, "camera_height_m": "unknown"})
    recordings = {
        "plain": write_plain(tmp_path / "plain", files, stamps, camera),
        "euroc": write_euroc(tmp_path / "euroc", files, stamps, camera),
        "ros1": write_bag(new_bag("ros1", "one"), files, stamps, camera),
        "ros2": write_bag(new_bag("sqlite", "two"), files, stamps, camera),
    }
    written = {}
    for kind, path in recordings.items():
        run = run_slam(path, weights=tiny_weights, overrides=SETTINGS, output=tmp_path / f"run_{kind}").path
        written[kind] = {file.name: file.read_bytes() for file in run.glob("trajectory_*.txt")}
    assert len(written["plain"]) == 6
    assert b"1403715273.262142" in written["plain"]["trajectory_optimised.tum.txt"]
    assert written["plain"] == written["euroc"] == written["ros1"] == written["ros2"]
