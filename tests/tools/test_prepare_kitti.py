"""A small copy of KITTI: same layout, scaled intrinsics, whole files, and resuming."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from erfsfm.data.discovery import discover
from erfsfm.evaluation.raw_drives import RawFrame, lidar_depth

TOOL = Path(__file__).parents[2] / "tools" / "prepare_kitti.py"
P2 = "100.0 0 47.5 30.0 0 80.0 31.5 2.0 0 0 1 0.25"


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("prepare_kitti", TOOL)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def root(tmp_path: Path) -> Path:
    base = tmp_path / "kitti" / "dataset"
    (base / "poses").mkdir(parents=True)
    for sequence in ("00", "04"):
        home = base / "sequences" / sequence
        for camera in ("image_2", "image_3"):
            (home / camera).mkdir(parents=True)
            for index in range(3):
                image = np.random.default_rng(index).integers(0, 255, (64, 96, 3), np.uint8)
                cv2.imwrite(str(home / camera / f"{index:06d}.png"), image)
        (home / "velodyne").mkdir()
        (home / "velodyne" / "000000.bin").write_bytes(b"1234")
        (home / "times.txt").write_text("0\n0.1\n0.2\n")
        rows = "".join(f"P{k}: {P2}\n" for k in range(4))
        (home / "calib.txt").write_text(rows + "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
        (base / "poses" / f"{sequence}.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    return tmp_path / "kitti"


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_an_odometry_root(tool: ModuleType, root: Path, tmp_path: Path) -> None:
    small = tmp_path / "small"
    written, kept = tool.prepare(root, small, tool.Size(48, 32))
    assert (written, kept) == (2 * (6 + 1) + 2, 0)
    wanted = files(root / "dataset") - {f"sequences/{s}/velodyne/000000.bin" for s in ("00", "04")}
    assert files(small) == wanted | {"prepared.json"}
    before, after = discover(root)[0], discover(small)[0]
    assert (after.camera.width, after.camera.height) == (48, 32)
    assert after.camera == before.camera.resized(48, 32), "as if the network's input had been resized"
    np.testing.assert_array_equal(after.image(1, 32, 48), before.image(1, 32, 48))
    np.testing.assert_allclose(after.t_camera_cam0, before.t_camera_cam0, rtol=1e-9)
    assert "Tr: 1 0 0 0 0 1 0 0 0 0 1 0" in (small / "sequences/00/calib.txt").read_text()
    assert (small / "poses/04.txt").read_text() == (root / "dataset/poses/04.txt").read_text()


def test_intrinsics_by_hand(tool: ModuleType, root: Path, tmp_path: Path) -> None:
    tool.prepare(root, tmp_path / "small", tool.Size(24, 32), ["04"])
    rows = (tmp_path / "small/sequences/04/calib.txt").read_text().splitlines()
    P = np.array([float(number) for number in rows[2].split()[1:]]).reshape(3, 4)
    np.testing.assert_allclose(P[:, :3], [[25, 0, (47.5 + 0.5) / 4 - 0.5], [0, 40, (31.5 + 0.5) / 2 - 0.5], [0, 0, 1]])
    point = np.array([1.0, 2.0, 10.0, 1.0])
    full = np.array([float(number) for number in P2.split()]).reshape(3, 4) @ point
    u, v = full[:2] / full[2]
    np.testing.assert_allclose((P @ point)[:2] / (P @ point)[2], [(u + 0.5) / 4 - 0.5, (v + 0.5) / 2 - 0.5])
    assert not (tmp_path / "small/sequences/00").exists()


def test_scans_and_jpg(tool: ModuleType, root: Path, tmp_path: Path) -> None:
    tool.prepare(root, tmp_path / "small", tool.Size(48, 32), ["00"], scans=True, jpg=True)
    assert (tmp_path / "small/sequences/00/velodyne/000000.bin").read_bytes() == b"1234"
    assert cv2.imread(str(tmp_path / "small/sequences/00/image_3/000002.jpg")).shape == (32, 48, 3)


def write_raw(root: Path) -> None:
    drive = root / "2011_09_26" / "2011_09_26_drive_0099_sync"
    for folder in ("image_02/data", "velodyne_points/data", "oxts/data"):
        (drive / folder).mkdir(parents=True)
    identity = "1 0 0 0 1 0 0 0 1"
    (root / "2011_09_26/calib_cam_to_cam.txt").write_text(
        f"calib_time: now\nR_rect_00: {identity}\nS_rect_02: 96 64\nP_rect_02: 60 0 47.5 0 0 60 31.5 0 0 0 1 0\n"
    )
    (root / "2011_09_26/calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")
    cv2.imwrite(str(drive / "image_02/data/0000000000.png"), np.zeros((64, 96, 3), np.uint8))
    (drive / "oxts/data/0000000000.txt").write_text("0 " * 30)
    (drive / "oxts/timestamps.txt").write_text("2011-09-26 13:10:51.1\n")
    points = np.array([[20, y, z, 0] for y in np.linspace(-8, 8, 40) for z in np.linspace(-5, 5, 30)], np.float32)
    points.tofile(drive / "velodyne_points/data/0000000000.bin")


def test_raw_drives(tool: ModuleType, tmp_path: Path) -> None:
    write_raw(tmp_path / "raw")
    tool.prepare(tmp_path / "raw", tmp_path / "small", tool.Size(48, 32), scans=True)
    assert files(tmp_path / "small") == files(tmp_path / "raw") | {"prepared.json"}
    frame = RawFrame(tmp_path / "small", "2011_09_26_drive_0099", 0)
    depth = lidar_depth(frame, (32, 48))
    assert depth[depth > 0] == pytest.approx(20)
    assert (depth > 0).mean() > 0.2
    (full,), (small,) = discover(tmp_path / "raw"), discover(tmp_path / "small")
    assert dataclasses.astuple(small.camera) == pytest.approx(dataclasses.astuple(full.camera.resized(48, 32)))
    assert small.name == full.name == "kitti_raw/2011_09_26_drive_0099"
    assert "S_rect_02: 4.8" in (tmp_path / "small/2011_09_26/calib_cam_to_cam.txt").read_text()
