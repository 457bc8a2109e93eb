from pathlib import Path

import numpy as np
import pytest

from slam.geometry import se3
from slam.runtime.errors import SequenceError
from slam.sequences.catalogue import open_sequence, sequence_kinds
from slam.sequences.kitti import T_world_imu

FRAMES = 5
DATE = "2011_09_26"
NAME = f"{DATE}_drive_0013"
CAM_TO_CAM = """calib_time: 09-Jan-2012 13:57:47
S_rect_02: 8.0e+01 4.8e+01
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: 60 0 39.5 0 0 60 23.5 0 0 0 1 0
P_rect_02: 60 0 39.5 6 0 60 23.5 0 0 0 1 0
"""
VELO_TO_CAM = "calib_time: now\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.1 -0.3\n"
IMU_TO_VELO = "calib_time: now\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n"


def times(offset_s: float) -> str:
    return "".join(f"2011-09-26 13:10:{51 + 0.1 * k + offset_s:012.9f}\n" for k in range(FRAMES))


def write_drive(root: Path, late_s: float = 0.0, name: str = NAME) -> Path:
    """A level drive north-east at 10 m/s; packets are taken ``late_s`` after their images."""
    import cv2

    drive = root / DATE / f"{name}_sync"
    (drive / "image_02/data").mkdir(parents=True)
    (drive / "oxts/data").mkdir(parents=True)
    (drive / "velodyne_points/data").mkdir(parents=True)
    (root / DATE / "calib_cam_to_cam.txt").write_text(CAM_TO_CAM)
    (root / DATE / "calib_velo_to_cam.txt").write_text(VELO_TO_CAM)
    (root / DATE / "calib_imu_to_velo.txt").write_text(IMU_TO_VELO)
    metres = 6378137.0 * np.pi / 180
    lat0, speed = 49.0, 10 / np.sqrt(2)
    for k in range(FRAMES):
        cv2.imwrite(str(drive / f"image_02/data/{k:010d}.png"), np.full((24, 40, 3), k, np.uint8))
        distance = speed * (0.1 * k + late_s)
        row = np.zeros(30)
        row[:3] = lat0 + distance / metres, 8.0 + distance / metres / np.cos(np.deg2rad(lat0)), 100
        row[5:8] = np.pi / 4, speed, speed
        (drive / f"oxts/data/{k:010d}.txt").write_text(" ".join(f"{x:.14g}" for x in row))
    (drive / "velodyne_points/data/0000000002.bin").write_bytes(
        np.array([7, 8, 9, 1], np.float32).tobytes()
    )
    (drive / "image_02/timestamps.txt").write_text(times(0.0))
    (drive / "oxts/timestamps.txt").write_text(times(late_s))
    return drive


@pytest.mark.parametrize("given", ["drive", "date", "root"])
@pytest.mark.parametrize("name", [None, NAME, f"{NAME}_sync", f"{DATE}/{NAME}_sync"])
def test_layouts(tmp_path: Path, given: str, name: str | None) -> None:
    drive = write_drive(tmp_path)
    dataset = {"drive": drive, "date": drive.parent, "root": tmp_path}[given]
    sequence = open_sequence(dataset, name, None, None)
    assert (sequence.name, len(sequence)) == (NAME, FRAMES)
    assert sequence.stamps == pytest.approx(np.arange(FRAMES) / 10)
    assert sequence.provenance() == (f"kitti_raw/{NAME}[0:5]",)
    assert sequence.scan(2).tolist() == [[7, 8, 9]] and not sequence.has_scan(1)


def test_calibration_follows_the_image_size(tmp_path: Path) -> None:
    sequence = open_sequence(write_drive(tmp_path), None, None, None)
    K = sequence.intrinsics
    assert (K.width, K.height, K.fx, K.fy, K.cx, K.cy) == (40, 24, 30, 30, 19.5, 11.5)
    # camera 2 is 0.1 m left of camera 0, the LiDAR 0.1 m above and 0.3 m behind camera 0
    assert sequence.T_camera_lidar is not None
    assert sequence.T_camera_lidar[:3, 3] == pytest.approx([0.1, -0.1, -0.3])


@pytest.mark.parametrize("late_s", [0.0, 0.008])
def test_reference_drives_along_z(tmp_path: Path, late_s: float) -> None:
    """The camera moves 1 m a frame straight ahead, whenever the packets were taken."""
    reference = open_sequence(write_drive(tmp_path, late_s), None, None, None).reference
    assert reference is not None and se3.is_se3(reference)
    assert np.array_equal(reference[0], np.eye(4))
    wanted = np.column_stack([np.zeros(FRAMES), np.zeros(FRAMES), np.arange(FRAMES)])
    assert reference[:, :3, 3] == pytest.approx(wanted, abs=1e-3)


def test_root_with_several_drives(tmp_path: Path) -> None:
    write_drive(tmp_path)
    write_drive(tmp_path, name=f"{DATE}_drive_0014")
    assert list(sequence_kinds(tmp_path)) == [NAME, f"{DATE}_drive_0014"]
    with pytest.raises(SequenceError, match="has 2 sequences"):
        open_sequence(tmp_path, None, None, None)
    assert open_sequence(tmp_path, f"{DATE}_drive_0014", None, None).name == f"{DATE}_drive_0014"


def test_optional_parts(tmp_path: Path) -> None:
    drive = write_drive(tmp_path)
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    sequence = open_sequence(drive, None, None, None)
    assert sequence.reference is None and sequence.T_camera_lidar is not None
    (drive.parent / "calib_velo_to_cam.txt").unlink()
    (drive / "image_02/timestamps.txt").unlink()
    sequence = open_sequence(drive, None, None, None)
    assert sequence.T_camera_lidar is None and sequence.camera_height_m == 1.65
    assert sequence.stamps == pytest.approx(np.arange(FRAMES) / 10)


def packet(**columns: float) -> np.ndarray:
    names = ["lat", "lon", "alt", "roll", "pitch", "yaw", "vn", "ve", "vf", "vl", "vu"]
    names += ["ax", "ay", "az", "af", "al", "au", "wx", "wy", "wz"]
    row = np.zeros(30)
    row[0] = 49.0
    for name, value in columns.items():
        row[names.index(name)] = value
    return row


def test_axes_by_hand() -> None:
    """Yaw 0 looks east and grows to the north; pitch puts the nose down, roll the left side up."""
    packets = np.stack([packet(), packet(yaw=np.pi / 2), packet(pitch=0.1), packet(roll=0.1)])
    R = T_world_imu(packets, np.zeros(4))[:, :3, :3]
    assert R[0] == pytest.approx(np.eye(3))
    assert R[1] @ [1, 0, 0] == pytest.approx([0, 1, 0], abs=1e-12)  # forward is north
    assert (R[2] @ [1, 0, 0])[2] == pytest.approx(-np.sin(0.1))  # nose down
    assert (R[3] @ [0, 1, 0])[2] == pytest.approx(np.sin(0.1))  # left side up


def test_a_step_north_and_east_in_metres() -> None:
    step = 1e-5
    packets = np.stack([packet(), packet(lat=49 + step), packet(lon=step)])
    t = T_world_imu(packets, np.zeros(3))[:, :3, 3]
    assert t[1] - t[0] == pytest.approx([0, 6378137 * np.deg2rad(step), 0], abs=1e-5)
    assert t[2] - t[0] == pytest.approx(
        [6378137 * np.deg2rad(step) * np.cos(np.deg2rad(49)), 0, 0], abs=1e-5
    )


def test_packets_are_extrapolated_to_their_image() -> None:
    moving = packet(vn=1.0, ve=2.0, vu=3.0, wz=0.5)[None]
    T = T_world_imu(np.concatenate([moving, moving]), np.array([0.0, 0.01]))
    assert T[1, :3, 3] - T[0, :3, 3] == pytest.approx([0.02, 0.01, 0.03])
    assert np.arctan2(T[1, 1, 0], T[1, 0, 0]) == pytest.approx(0.005)
