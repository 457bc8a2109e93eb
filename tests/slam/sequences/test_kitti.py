import json
import logging
from pathlib import Path

import numpy as np
import pytest

from slam.geometry import se3
from slam.runtime.errors import MissingFrameError, SequenceError, SlamError
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


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("layout", ["root", "dataset", "sequences", "one"])
def test_layouts_and_formats(tmp_path: Path, odometry, layout: str, suffix: str):
    base = tmp_path / "dataset" if layout == "dataset" else tmp_path
    odometry(base, suffix=suffix)
    given = {"sequences": base / "sequences", "one": base / "sequences" / "00"}.get(
        layout, tmp_path
    )
    sequence = open_sequence(given, "00")
    assert (sequence.name, len(sequence)) == ("00", 6)
    assert sequence.frame(3).image[0, 0] == pytest.approx([30, 30, 30], abs=2)
    assert sequence.frame(3).image.shape == (24, 40, 3)
    assert sequence.frame(3).stamp == pytest.approx(0.3) and sequence.frame(3).index == 3
    assert sequence.reference is not None and sequence.camera_height_m == 1.65
    assert sequence.provenance() == ("kitti_odometry/00[0:6]",)


@pytest.mark.parametrize("camera", [0, 1, 2, 3])
def test_each_camera_has_its_intrinsics_and_reference(tmp_path: Path, odometry, camera: int):
    folder = odometry(tmp_path, camera=camera)
    rows = (folder / "calib.txt").read_text().splitlines()
    rows[camera] = rows[camera].replace("30 0 20", "31 0 20", 1).replace("30 12", "31 12")
    (folder / "calib.txt").write_text("\n".join(rows))
    sequence = open_sequence(tmp_path)
    assert sequence.intrinsics.fx == 31
    assert np.array_equal(sequence.reference[0], np.eye(4))
    # camera 0 drives 1 m a frame along its z axis without turning: every camera of the rig does
    assert sequence.reference[4, :3, 3] == pytest.approx([0, 0, 4])


def test_reference_of_a_turning_rig(tmp_path: Path, odometry):
    """The rig turns right by 90 degrees about camera 0; camera 2, 6 cm left of it, swings forward."""
    odometry(tmp_path, frames=2)
    (tmp_path / "poses/00.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n0 0 1 0 0 1 0 0 -1 0 0 0\n")
    reference = open_sequence(tmp_path, "00").reference
    assert reference[1, :3, 3] == pytest.approx([0.06, 0, 0.06])


def test_colour_is_preferred_to_grey(tmp_path: Path, odometry):
    odometry(tmp_path, camera=0)
    odometry(tmp_path, camera=3, suffix=".jpg")
    sequence = open_sequence(tmp_path, "00")
    # Tr puts the LiDAR at (0.1, 0.2, 0.3) of camera 0; camera 3 is 0.47 m right of it
    assert sequence.T_camera_lidar[:3, 3] == pytest.approx([0.1 - 0.47, 0.2, 0.3])


def test_scans(tmp_path: Path, odometry):
    folder = odometry(tmp_path)
    (folder / "velodyne").mkdir()
    (folder / "velodyne" / "000002.bin").write_bytes(np.array([7, 8, 9, 1], np.float32).tobytes())
    sequence = open_sequence(tmp_path, "00", None, "1:4")
    assert sequence.has_scan(1) and not sequence.has_scan(0)
    assert sequence.scan(1).tolist() == [[7, 8, 9]]
    with pytest.raises(SequenceError, match="frame 0 of 00 has no scan"):
        sequence.scan(0)


def test_missing_times_fall_back(tmp_path: Path, odometry, caplog: pytest.LogCaptureFixture):
    folder = odometry(tmp_path)
    (folder / "times.txt").unlink()
    with caplog.at_level(logging.WARNING):
        sequence = open_sequence(tmp_path, "00")
    assert sequence.stamps == pytest.approx(np.arange(6) / 10)
    assert "times.txt" in caplog.text


def test_simulated_root(tmp_path: Path, odometry, camera_yaml: str):
    odometry(tmp_path, name="sim")
    (tmp_path / "camera.yaml").write_text(camera_yaml + "camera_height_m: 1.52\n")
    (tmp_path / "simulation.json").write_text(json.dumps({"seed": 612}))
    sequence = open_sequence(tmp_path, None, None, "0:3")
    assert sequence.camera_height_m == 1.52
    assert sequence.provenance() == ("simulated/612",)
    (tmp_path / "simulation.json").write_text("{}")
    with pytest.raises(SequenceError, match="must hold the simulation's seed"):
        open_sequence(tmp_path)


def test_given_camera_replaces_calibration(tmp_path: Path, odometry, camera_yaml: str):
    odometry(tmp_path)
    path = tmp_path / "mine.yaml"
    path.write_text(camera_yaml.replace("fx: 30", "fx: 33") + "camera_height_m: unknown\n")
    sequence = open_sequence(tmp_path, "00", path, None)
    assert sequence.intrinsics.fx == 33 and sequence.camera_height_m is None


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("image_2/left.png", "", r"left\.png is not named by its number"),
        (
            "calib.txt",
            "P2: 45 0 30 0 0 45 18 0 0 0 1 0",
            r"principal point \(30, 18\) in row P2 is far .*different sizes",
        ),
        ("calib.txt", None, r"no calib\.txt in "),
        ("calib.txt", "P2: 1 2 3\n", "row P2 has 3 numbers"),
        (
            "../../poses/00.txt",
            "1 0 0 0 0 1 0 0 0 0 1 0\n" * 4,
            r"00\.txt has 4 poses for 6 images: .*cut the poses",
        ),
        ("../../poses/00.txt", "1 0 0\n" * 6, r"00\.txt"),
        ("times.txt", "0\n0.1\n", r"times\.txt has 2 rows for 6 images"),
        ("times.txt", "one\n" * 6, r"times\.txt, line 1"),
        ("image_2/*.png", "", r"000000\.png is empty"),
        ("image_2/*.png", None, "looked for png or jpg in .*image_2"),
    ],
)
def test_broken_sequences(tmp_path: Path, odometry, file: str, content: str | None, message: str):
    folder = odometry(tmp_path)
    for path in [*folder.glob(file)] or [folder / file]:
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_text(content)
    with pytest.raises(SlamError, match=message) as caught:
        open_sequence(tmp_path, "00")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("bad", ["1", "soon", "nan"])
@pytest.mark.parametrize("row", [2, 5])
def test_a_bad_time_is_interpolated(tmp_path: Path, odometry, bad: str, row: int):
    times = [str(k) for k in range(6)]
    times[row] = bad
    (odometry(tmp_path) / "times.txt").write_text("\n".join(times))
    np.testing.assert_allclose(open_sequence(tmp_path, "00").stamps, np.arange(6), atol=1e-9)


def test_a_bad_pose_is_bridged(tmp_path: Path, odometry):
    odometry(tmp_path)
    path = tmp_path / "poses/00.txt"
    rows = path.read_text().splitlines()
    path.write_text("\n".join([rows[0], "nan " * 12, *rows[2:5], rows[5][:20]]))
    poses = open_sequence(tmp_path, "00").T_any_camera
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1), 1, atol=1e-6
    )


def test_later_damage_is_an_error_when_read(tmp_path: Path, odometry):
    folder = odometry(tmp_path)
    path = folder / "image_2/000004.png"
    path.write_bytes(path.read_bytes()[:40])
    sequence = open_sequence(tmp_path, "00")
    sequence.frame(3)
    with pytest.raises(SequenceError, match=r"000004\.png is truncated"):
        sequence.frame(4)
    with pytest.raises(SequenceError, match="no frame 6 in sequence 00: it has frames 0 to 5"):
        sequence.frame(6)


@pytest.fixture
def gap(tmp_path: Path, odometry) -> Path:
    """A sequence of frames 1 to 9 without 3, 4 and 8; it drives 1 m a frame, and starts with frame 0 in its files."""
    folder = odometry(tmp_path, frames=10)
    for number in (0, 3, 4, 8):
        (folder / f"image_2/{number:06d}.png").unlink()
    (folder / "velodyne").mkdir()
    (folder / "velodyne/000005.bin").write_bytes(np.array([7, 8, 9, 1], np.float32).tobytes())
    return folder


def kept(path: Path, numbers: list[int]) -> None:
    rows = path.read_text().splitlines()
    path.write_text("".join(f"{rows[number]}\n" for number in numbers))


@pytest.mark.parametrize("times", [range(10), range(1, 10), [1, 2, 5, 6, 7, 9], None])
@pytest.mark.parametrize("poses", [range(10), range(1, 10), [1, 2, 5, 6, 7, 9]])
def test_missing_numbers_are_missing_frames(
    tmp_path: Path,
    gap: Path,
    caplog: pytest.LogCaptureFixture,
    times: list[int] | None,
    poses: list[int],
):
    if times is None:
        (gap / "times.txt").unlink()
    else:
        kept(gap / "times.txt", times)
    kept(tmp_path / "poses/00.txt", poses)
    sequence = open_sequence(tmp_path)
    assert len(sequence) == len(sequence.stamps) == 9
    assert np.diff(sequence.stamps) == pytest.approx(0.1)
    assert sequence.reference[:, :3, 3] == pytest.approx(
        np.outer(np.arange(9), [0, 0, 1]), abs=1e-9
    )
    assert [sequence.frame(row).image[0, 0, 0] for row in (0, 1, 4, 8)] == [10, 20, 50, 90]
    assert sequence.provenance() == ("kitti_odometry/00[1:10]",)
    assert sequence.scan(4).tolist() == [[7, 8, 9]]
    with pytest.raises(MissingFrameError, match=r"no image 000008\.png in .*image_2"):
        sequence.frame(7)
    said = [record.getMessage() for record in caplog.records if "no image" in record.getMessage()]
    assert len(said) == 1
    assert "3 of 9 frames have no image; the first gap is 000003.png to 000004.png" in said[0]


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
def test_layouts(tmp_path: Path, given: str, name: str | None):
    drive = write_drive(tmp_path)
    dataset = {"drive": drive, "date": drive.parent, "root": tmp_path}[given]
    sequence = open_sequence(dataset, name)
    assert (sequence.name, len(sequence)) == (NAME, FRAMES)
    assert sequence.stamps == pytest.approx(np.arange(FRAMES) / 10)
    assert sequence.provenance() == (f"kitti_raw/{NAME}[0:5]",)
    assert sequence.scan(2).tolist() == [[7, 8, 9]] and not sequence.has_scan(1)


def test_calibration_follows_the_image_size(tmp_path: Path):
    sequence = open_sequence(write_drive(tmp_path))
    K = sequence.intrinsics
    assert (K.width, K.height, K.fx, K.fy, K.cx, K.cy) == (40, 24, 30, 30, 19.5, 11.5)
    # camera 2 is 0.1 m left of camera 0, the LiDAR 0.1 m above and 0.3 m behind camera 0
    assert sequence.T_camera_lidar[:3, 3] == pytest.approx([0.1, -0.1, -0.3])


@pytest.mark.parametrize("late_s", [0.0, 0.008])
def test_reference_drives_along_z(tmp_path: Path, late_s: float):
    """The camera moves 1 m a frame straight ahead, whenever the packets were taken."""
    reference = open_sequence(write_drive(tmp_path, late_s)).reference
    assert reference is not None and se3.is_se3(reference)
    assert np.array_equal(reference[0], np.eye(4))
    wanted = np.column_stack([np.zeros(FRAMES), np.zeros(FRAMES), np.arange(FRAMES)])
    assert reference[:, :3, 3] == pytest.approx(wanted, abs=1e-3)


def test_root_with_several_drives(tmp_path: Path):
    write_drive(tmp_path)
    write_drive(tmp_path, name=f"{DATE}_drive_0014")
    assert list(sequence_kinds(tmp_path)) == [NAME, f"{DATE}_drive_0014"]
    with pytest.raises(SequenceError, match="has 2 sequences"):
        open_sequence(tmp_path)
    assert open_sequence(tmp_path, f"{DATE}_drive_0014").name == f"{DATE}_drive_0014"


def test_optional_parts(tmp_path: Path):
    drive = write_drive(tmp_path)
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    sequence = open_sequence(drive)
    assert sequence.reference is None and sequence.T_camera_lidar is not None
    (drive.parent / "calib_velo_to_cam.txt").unlink()
    (drive / "image_02/timestamps.txt").unlink()
    sequence = open_sequence(drive)
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


def test_axes_by_hand():
    """Yaw 0 looks east and grows to the north; pitch puts the nose down, roll the left side up."""
    packets = np.stack([packet(), packet(yaw=np.pi / 2), packet(pitch=0.1), packet(roll=0.1)])
    R = T_world_imu(packets, np.zeros(4))[:, :3, :3]
    assert R[0] == pytest.approx(np.eye(3))
    assert R[1] @ [1, 0, 0] == pytest.approx([0, 1, 0], abs=1e-12)  # forward is north
    assert (R[2] @ [1, 0, 0])[2] == pytest.approx(-np.sin(0.1))  # nose down
    assert (R[3] @ [0, 1, 0])[2] == pytest.approx(np.sin(0.1))  # left side up


def test_packets_are_extrapolated_to_their_image():
    moving = packet(vn=1.0, ve=2.0, vu=3.0, wz=0.5)[None]
    T = T_world_imu(np.concatenate([moving, moving]), np.array([0.0, 0.01]))
    assert T[1, :3, 3] - T[0, :3, 3] == pytest.approx([0.02, 0.01, 0.03])
    assert np.arctan2(T[1, 1, 0], T[1, 0, 0]) == pytest.approx(0.005)
