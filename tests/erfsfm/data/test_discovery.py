"""Discovery of recordings under a root, and the errors."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from erfsfm.common.errors import DataError
from erfsfm.data.discovery import INDOOR_HEIGHT_M, discover, open_drive
from erfsfm.data.recordings import Recording
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import write_kitti_root
from slam.simulation.rooms import SimulatedRooms

CAMERA = {"width": 48, "height": 32, "fx": 40.0, "fy": 41.0, "cx": 23.5, "cy": 15.5, "fps": 10}


def write_images(
    folder: Path, count: int = 3, size: tuple[int, int] = (32, 48), suffix: str = ".png"
) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        image = np.zeros((*size, 3), np.uint8)
        image[..., 2] = 200  # red, in OpenCV's order
        image[..., 1] = index
        cv2.imwrite(str(folder / f"{index:04d}{suffix}"), image)
    return folder


def write_camera(folder: Path, **changes: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera.yaml").write_text(yaml.safe_dump(CAMERA | changes))
    return folder


def one(root: Path) -> Recording:
    (recording,) = discover(root)
    return recording


def refusal(root: Path) -> str:
    with pytest.raises(DataError) as caught:
        for recording in discover(root):
            for index in range(len(recording)):
                recording.image(index, recording.camera.height, recording.camera.width)
                recording.true_depth(index)
            recording.true_poses()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("prefix", ["", "dataset"])
def test_kitti_root(tmp_path, write_root, prefix):
    write_root(tmp_path / prefix, sequences=("00", "09"), frames=4)
    recordings = discover(tmp_path)
    assert [r.name for r in recordings] == ["kitti_odometry/00", "kitti_odometry/09"]
    assert [len(r) for r in recordings] == [4, 4]
    camera = recordings[0].camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (
        96,
        64,
        60,
        62,
        47.5,
        31.5,
    )
    assert isinstance(camera.fx, float)


def test_simulated_root_is_named_by_its_seed(tmp_path, write_root):
    write_root(tmp_path, frames=3, seed=17, depth=True)
    recording = one(tmp_path)
    assert recording.name == "simulated/17"
    assert recording.frames_name == "simulated/17[0:3]"
    depth = recording.true_depth(1)
    assert depth.dtype == np.float32
    assert float(depth[0, 0]) == pytest.approx(5.9, abs=1 / 256)


def test_rooms_are_exact_in_a_unit_of_their_own(tmp_path):
    rooms = SimulatedRooms(SimulationOptions("rooms", 2, 0, 64, 48))
    write_kitti_root(rooms, tmp_path / "rooms", depth=True)
    (recording,) = discover(tmp_path / "rooms")
    assert recording.exact
    assert recording.camera_height_m == INDOOR_HEIGHT_M


def test_poses_and_parts(tmp_path, write_root):
    write_root(tmp_path, frames=6, depth=True, step=(0.0, 0.0, 0.5))
    whole = one(tmp_path)
    part = whole.part(2, 5)
    assert len(part) == 3
    assert (part.start, part.frames_name) == (2, "kitti_odometry/00[2:5]")
    assert part.part(1, 3).frames_name == "kitti_odometry/00[3:5]"
    poses, depth = part.true_poses(), part.true_depth(0)
    np.testing.assert_allclose(poses[:, 2, 3], [1.0, 1.5, 2.0])
    assert float(depth[0, 0]) == pytest.approx(5.0)
    assert (part.image(0, 64, 96) == whole.image(2, 64, 96)).all()
    assert len(whole.part(4, 10**9)) == 2


def test_poses_are_those_of_the_camera_that_took_the_images(tmp_path, write_root):
    """P2 with 60 px * 0.5 m in its last column: camera 2 is half a metre left of camera 0, which rotates left."""
    write_root(tmp_path, frames=2)
    (tmp_path / "sequences/00/calib.txt").write_text("P2: 60 0 47.5 30 0 62 31.5 0 0 0 1 0\n")
    (tmp_path / "poses/00.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n0 0 -1 3 0 1 0 0 1 0 0 0\n")
    recording = one(tmp_path)
    assert recording.t_camera_cam0 == pytest.approx((0.5, 0, 0))
    poses, paper = recording.true_poses(), recording.true_poses("paper")
    np.testing.assert_allclose(poses[:, :3, 3], [[-0.5, 0, 0], [3, 0, -0.5]], atol=1e-12)
    np.testing.assert_allclose(paper[:, :3, 3], [[0, 0, 0], [3, 0, 0]])


@pytest.mark.parametrize("inside", ["", "images"])
def test_image_folder(tmp_path, inside):
    root = write_camera(tmp_path / "my_drive")
    write_images(root / inside)
    recording = one(root)
    assert recording.name == "folder/my_drive"
    assert len(recording) == 3
    image = recording.image(1, 32, 48)
    assert image[0, 0].tolist() == [200, 1, 0], "RGB"
    assert recording.image(1, 16, 24).shape == (16, 24, 3)


def test_a_camera_that_is_given_comes_before_the_one_beside_the_images(tmp_path):
    """Of several drives under one root, without a camera of their own, too."""
    file = write_camera(tmp_path / "calibration", fx=50.0, fy=50.0) / "camera.yaml"
    write_images(write_camera(tmp_path / "root/first"))
    write_images(tmp_path / "root/second/images")
    (tmp_path / "root/third").mkdir()
    write_video(tmp_path / "root/third/drive.avi")
    found = discover(tmp_path / "root", file)
    assert [each.name for each in found] == ["folder/first", "folder/second", "folder/third"]
    assert {each.camera.fx for each in found} == {50.0}


def write_video(path: Path, frames: int = 4) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (48, 32))
    for index in range(frames):
        writer.write(np.full((32, 48, 3), 40 * index, np.uint8))
    writer.release()


@pytest.mark.parametrize("give", ["drive.avi", ""])
def test_video(tmp_path, give):
    root = write_camera(tmp_path / "trip")
    write_video(root / "drive.avi")
    recording = one(root / give)
    assert (recording.name, recording.frames_name) == ("folder/trip", "folder/trip[0:4]")
    assert float(recording.image(2, 32, 48).mean()) == pytest.approx(80, abs=3)
    part = recording.part(1, 3)
    assert (len(part), part.frames_name) == (2, "folder/trip[1:3]")
    assert (part.image(1, 32, 48) == recording.image(2, 32, 48)).all()


# what goes wrong, in one line each


@pytest.mark.parametrize("content", [[], ["readme.txt"], ["sequences/"], ["sequences/00/"]])
def test_a_root_without_recordings(tmp_path, content):
    for name in content:
        if name.endswith("/"):
            (tmp_path / name).mkdir(parents=True)
        else:
            (tmp_path / name).write_text("")
    assert "no recording" in refusal(tmp_path)


def test_poses_that_are_no_rotations(tmp_path, write_root):
    write_root(tmp_path, frames=1)
    (tmp_path / "poses/00.txt").write_text("0 0 0 0 0 0 0 0 0 0 0 0\n")
    assert "no rotation" in refusal(tmp_path)


def test_a_recording_is_split_at_its_gaps(tmp_path, write_root, caplog):
    write_root(tmp_path, frames=9, depth=True, step=(0.0, 0.0, 0.5))
    for number in (0, 3, 4):
        (tmp_path / f"sequences/00/image_2/{number:06d}.png").unlink()
    first, second = discover(tmp_path)
    assert (first.frames_name, second.frames_name) == (
        "kitti_odometry/00[1:3]",
        "kitti_odometry/00[5:9]",
    )
    assert "2 of 8 frames have no image; the first gap is 000003.png to 000004.png" in caplog.text
    for recording, places in ((first, [0.5, 1.0]), (second, [2.5, 3.0, 3.5, 4.0])):
        T_world_camera, depth = recording.true_poses(), recording.true_depth(1)
        assert T_world_camera is not None and depth is not None
        np.testing.assert_allclose(T_world_camera[:, 2, 3], places)
        assert float(depth[0, 0]) == pytest.approx(6.0 - places[1], abs=1 / 256)
        assert recording.images[0].stem == f"{recording.start:06d}"
    assert second.within(0, 6) == second.part(0, 1)
    assert second.within(0, 5) is None and second.within(9, 12) is None


NAME = "kitti_raw/2011_09_26_drive_0001"


@pytest.mark.parametrize("place", ["", "2011_09_26", "2011_09_26/2011_09_26_drive_0001_sync"])
def test_root_may_be_a_date_or_a_drive(tmp_path, write_raw, place):
    write_raw(tmp_path / "raw")
    left, right = discover(tmp_path / "raw" / place)
    assert left.frames_name == right.frames_name == f"{NAME}[0:6]"
    assert [recording.images[0].parts[-3] for recording in (left, right)] == [
        "image_02",
        "image_03",
    ]


def test_every_drive_of_every_date(tmp_path, write_raw):
    for drive in ("2011_10_03_drive_0047", "2011_09_26_drive_0005", "2011_09_26_drive_0002"):
        write_raw(tmp_path, drive=drive, frames=1)
    (tmp_path / "2011_09_26/2011_09_26_drive_0009_sync/oxts").mkdir(
        parents=True
    )  # downloaded in part
    names = [recording.name.removeprefix("kitti_raw/") for recording in discover(tmp_path)]
    assert names == [
        name
        for name in ("2011_09_26_drive_0002", "2011_09_26_drive_0005", "2011_10_03_drive_0047")
        for _ in range(2)
    ]


def test_intrinsics_follow_the_stored_size(tmp_path, write_raw):
    full, _ = open_drive(write_raw(tmp_path / "full"))
    half, _ = open_drive(write_raw(tmp_path / "half", stored=(32, 48)))
    assert (full.camera.width, full.camera.fx, full.camera.cx) == (96, 60, 47)
    assert half.camera == full.camera.resized(48, 32)
    assert half.camera.cx == pytest.approx((47 + 0.5) / 2 - 0.5)
    right = open_drive(tmp_path / "full/2011_09_26/2011_09_26_drive_0001_sync")[1]
    assert right.camera.cx == 46, "each camera has its own row"


def test_grey_cameras_where_there_is_no_colour(tmp_path, write_raw):
    drive = write_raw(tmp_path)
    shutil.copytree(drive / "image_02", drive / "image_00")
    for camera in ("image_02", "image_03"):
        shutil.rmtree(drive / camera)
    (recording,) = open_drive(drive)
    assert recording.images[0].parts[-3] == "image_00"


def test_parts_keep_the_numbers_of_the_drive(tmp_path, write_raw):
    drive = write_raw(tmp_path, speeds=[9.0] * 6)
    for camera in ("image_02", "image_03"):
        for number in (0, 3):
            (drive / camera / f"data/{number:010d}.png").unlink()
    assert [r.frames_name for r in open_drive(drive)] == 2 * [f"{NAME}[1:3]", f"{NAME}[4:6]"]


@pytest.mark.data
def test_a_real_drive(data_root):
    (recording,) = discover(data_root / "kitti_raw")
    assert recording.frames_name == "kitti_raw/2011_09_26_drive_0013[0:144]"
    camera = recording.camera
    assert (camera.width, camera.height) == (828, 250)
    assert camera.fx == pytest.approx(721.5377 * 828 / 1242)
    assert camera.cy == pytest.approx((172.854 + 0.5) * 250 / 375 - 0.5)
