"""Raw drives as recordings: cameras, intrinsics, and the errors of incomplete drives."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from erfsfm.data.discovery import discover, open_drive

WriteDrive = Callable[..., Path]
NAME = "kitti_raw/2011_09_26_drive_0001"


@pytest.mark.parametrize("place", ["", "2011_09_26", "2011_09_26/2011_09_26_drive_0001_sync"])
def test_root_may_be_a_date_or_a_drive(tmp_path: Path, write_raw: WriteDrive, place: str) -> None:
    write_raw(tmp_path / "raw")
    left, right = discover(tmp_path / "raw" / place)
    assert left.frames_name == right.frames_name == f"{NAME}[0:6]"
    assert [recording.images[0].parts[-3] for recording in (left, right)] == ["image_02", "image_03"]


def test_every_drive_of_every_date(tmp_path: Path, write_raw: WriteDrive) -> None:
    for drive in ("2011_10_03_drive_0047", "2011_09_26_drive_0005", "2011_09_26_drive_0002"):
        write_raw(tmp_path, drive=drive, frames=1)
    (tmp_path / "2011_09_26/2011_09_26_drive_0009_sync/oxts").mkdir(parents=True)  # downloaded in part
    names = [recording.name.removeprefix("kitti_raw/") for recording in discover(tmp_path)]
    assert names == [
        name for name in ("2011_09_26_drive_0002", "2011_09_26_drive_0005", "2011_10_03_drive_0047") for _ in range(2)
    ]


def test_intrinsics_follow_the_stored_size(tmp_path: Path, write_raw: WriteDrive) -> None:
    full, _ = open_drive(write_raw(tmp_path / "full"))
    half, _ = open_drive(write_raw(tmp_path / "half", stored=(32, 48)))
    assert (full.camera.width, full.camera.fx, full.camera.cx) == (96, 60, 47)
    assert half.camera == full.camera.resized(48, 32)
    assert half.camera.cx == pytest.approx((47 + 0.5) / 2 - 0.5)
    right = open_drive(tmp_path / "full/2011_09_26/2011_09_26_drive_0001_sync")[1]
    assert right.camera.cx == 46, "each camera has its own row"


def test_grey_cameras_where_there_is_no_colour(tmp_path: Path, write_raw: WriteDrive) -> None:
    drive = write_raw(tmp_path)
    shutil.copytree(drive / "image_02", drive / "image_00")
    for camera in ("image_02", "image_03"):
        shutil.rmtree(drive / camera)
    (recording,) = open_drive(drive)
    assert recording.images[0].parts[-3] == "image_00"


def test_parts_keep_the_numbers_of_the_drive(tmp_path: Path, write_raw: WriteDrive) -> None:
    drive = write_raw(tmp_path, speeds=[9.0] * 6)
    for camera in ("image_02", "image_03"):
        for number in (0, 3):
            (drive / camera / f"data/{number:010d}.png").unlink()
    assert [r.frames_name for r in open_drive(drive)] == 2 * [f"{NAME}[1:3]", f"{NAME}[4:6]"]


@pytest.mark.data
def test_a_real_drive(data_root: Path) -> None:
    (recording,) = discover(data_root / "kitti_raw")
    assert recording.frames_name == "kitti_raw/2011_09_26_drive_0013[0:144]"
    camera = recording.camera
    assert (camera.width, camera.height) == (828, 250)
    assert camera.fx == pytest.approx(721.5377 * 828 / 1242)
    assert camera.cy == pytest.approx((172.854 + 0.5) * 250 / 375 - 0.5)
