from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from slam.geometry import se3
from slam.runtime.errors import SequenceError
from slam.sequences.catalogue import open_sequence, sequence_kinds

pytestmark = pytest.mark.data
# path, name, frames, path length in metres (None without truth), camera height in metres
RECORDINGS = [
    ("kitti_odometry", "00", 300, 216, 1.65),
    ("kitti_odometry", "02", 300, 355, 1.65),
    ("kitti_odometry", "05", 300, 231, 1.65),
    ("kitti_odometry_original", "00", 60, None, 1.65),
    ("kitti_raw", "2011_09_26_drive_0013", 144, 173, 1.65),
    ("folders/kitti_colour_a", None, 268, None, 1.65),
    ("folders/kitti_video_b", None, 91, None, 1.65),
    ("folders/kitti_video_b/drive.mp4", None, 91, None, 1.65),
    ("folders/karlsruhe_2010_03_09", None, 373, None, None),
]


def test_several_sequences_are_listed(tmp_path: Path, odometry):
    for name in ("02", "10", "00"):
        odometry(tmp_path, name=name, frames=2)
    assert list(sequence_kinds(tmp_path)) == ["00", "02", "10"]
    with pytest.raises(
        SequenceError, match="has 3 sequences: 00, 02, 10; choose one with --sequence"
    ):
        open_sequence(tmp_path)
    with pytest.raises(SequenceError) as caught:
        open_sequence(tmp_path, "09")
    assert str(caught.value) == (
        f"no sequence 09 in {tmp_path}: found 00, 02, 10 under {tmp_path / 'sequences'}; "
        "choose one of them with --sequence"
    )


def test_sequence_without_images_says_so(tmp_path: Path, odometry):
    odometry(tmp_path)
    (tmp_path / "sequences/09").mkdir()
    (tmp_path / "sequences/09/calib.txt").write_text("")
    assert list(sequence_kinds(tmp_path)) == ["00"]
    with pytest.raises(SequenceError, match=r"no images in .*09: looked for .*image_2"):
        open_sequence(tmp_path, "09")


def test_name_of_a_folder_inside(tmp_path: Path, images, camera_yaml: str):
    images(tmp_path / "mine", ["0.png", "1.png"])
    (tmp_path / "mine" / "camera.yaml").write_text(camera_yaml)
    assert open_sequence(tmp_path, "mine").name == "mine"
    assert open_sequence(tmp_path / "mine", "mine").name == "mine"
    with pytest.raises(SequenceError, match=r"no sequence yours in .*found mine"):
        open_sequence(tmp_path / "mine", "yours")


def test_the_door_is_light():
    code = "import sys, slam.sequences.catalogue; print({'torch', 'gtsam', 'open3d', 'evo'} & sys.modules.keys())"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert answer.stdout.strip() == "set()"


def test_a_folder_of_recordings_lists_all(tmp_path: Path, images, odometry, camera_yaml: str):
    images(tmp_path / "left", ["0.png"])
    images(tmp_path / "right/images", ["0.png"])
    odometry(tmp_path / "kitti", name="03", frames=2)
    odometry(tmp_path / "kitti", name="04", frames=2)
    (
        tmp_path / "2011_09_26_drive_0013_extract"
    ).mkdir()  # refused where it is given, here it is only left out
    (tmp_path / "camera.yaml").write_text(camera_yaml)
    kinds = {
        "kitti/03": "KITTI odometry",
        "kitti/04": "KITTI odometry",
        "left": "images",
        "right": "images",
    }
    assert sequence_kinds(tmp_path) == kinds
    for name in kinds:
        assert len(open_sequence(tmp_path, name)) == 1 + ("kitti" in name)
    with pytest.raises(
        SequenceError, match="has 4 sequences: kitti/03, kitti/04, left, right; choose one"
    ):
        open_sequence(tmp_path)


def write_clip(path: Path, first: int, count: int = 20) -> None:
    """Frames at 10 a second, each as bright as its number."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (40, 24))
    for k in range(first, first + count):
        writer.write(np.full((24, 40, 3), k, np.uint8))
    writer.release()


@pytest.fixture
def trip(tmp_path: Path, camera_yaml: str) -> Path:
    (tmp_path / "camera.yaml").write_text(camera_yaml.replace("fps: 5", "fps: 10"))
    return tmp_path


def shown(sequence) -> list[int]:
    return [round(float(sequence.frame(k).image.mean())) for k in range(len(sequence))]


def test_chapters_of_a_camera(trip: Path):
    for k, name in enumerate(("GX010042", "GX020042", "GX030042")):
        write_clip(trip / f"{name}.avi", 20 * k)
    write_clip(trip / "GX010043.avi", 200)
    assert sorted(sequence_kinds(trip)) == ["GX010042", "GX010043"]
    sequence = open_sequence(trip, "GX010042")
    np.testing.assert_allclose(shown(sequence), range(60), atol=2)
    np.testing.assert_allclose(sequence.stamps, 0.1 * np.arange(60), atol=1e-6)
    assert len(open_sequence(trip / "GX020042.avi")) == 20
    assert sequence.provenance()[1].endswith("GX020042[0:20]")
    (trip / "GX020042.avi").unlink()
    gap = np.diff(open_sequence(trip, "GX010042").stamps)
    np.testing.assert_allclose(gap[[18, 19, 20]], [0.1, 2.1, 0.1], atol=1e-6)


def test_files_named_by_their_time(trip: Path):
    for k, second in enumerate((0, 2, 4, 8, 59)):
        write_clip(trip / f"20240101_1200{second:02d}_F.avi", 20 * k)
    assert sorted(sequence_kinds(trip)) == ["20240101_120000_F", "20240101_120059_F"]
    sequence = open_sequence(trip, "20240101_120000_F")
    assert len(sequence) == 80
    np.testing.assert_allclose(np.diff(sequence.stamps)[[19, 39, 59]], [0.1, 0.1, 2.1], atol=1e-6)


def test_two_trips_of_a_day_are_two_recordings(trip: Path):
    for k, hour in enumerate((8, 18)):
        write_clip(trip / f"20240101_{hour:02d}0000_F.avi", 20 * k)
    assert sorted(sequence_kinds(trip)) == ["20240101_080000_F", "20240101_180000_F"]
    later = open_sequence(trip, "20240101_180000_F")
    np.testing.assert_allclose(shown(later), range(20, 40), atol=2)


def test_clips_named_by_the_minute_that_are_shorter(trip: Path, caplog: pytest.LogCaptureFixture):
    for k, minute in enumerate((0, 1, 2, 4)):
        write_clip(trip / f"20240101_12{minute:02d}00_F.avi", 20 * k)
    gaps = np.diff(open_sequence(trip).stamps)
    np.testing.assert_allclose(gaps[[19, 39, 59]], [0.1, 0.1, 2.1], atol=1e-6)
    assert "named 60 s apart: taken as following each other" in caplog.text


def test_numbered_folders(trip: Path, images):
    for name in ("000", "001"):
        images(trip / name, [f"{k}.png" for k in range(5)])
    sequence = open_sequence(trip)
    assert len(sequence) == 10 and (np.diff(sequence.stamps) > 0).all()


@pytest.mark.parametrize(
    "names",
    [
        ("GOPR0042", "GP010042", "GP020042"),
        ("2024_0101_120000_0001F", "2024_0101_120002_0002F", "2024_0101_120004_0003F"),
        ("NO20240101-120000-000001F", "NO20240101-120002-000002F", "NO20240101-120004-000003F"),
        ("walk_part1", "walk_part2", "walk_part3"),
    ],
)
def test_namings_of_pieces(trip: Path, names: tuple[str, ...]):
    for k, name in enumerate(names):
        write_clip(trip / f"{name}.avi", 20 * k)
    np.testing.assert_allclose(open_sequence(trip).stamps, 0.1 * np.arange(60), atol=1e-6)


@pytest.mark.parametrize("path, name, frames, length_m, height_m", RECORDINGS)
def test_opens(
    data_root: Path, path: str, name: str | None, frames: int, length_m: float | None, height_m
):
    sequence = open_sequence(data_root / path, name)
    assert len(sequence) == frames == len(sequence.stamps)
    K = sequence.intrinsics
    for index in (0, frames // 2, frames - 1):
        image = sequence.frame(index).image
        assert image.shape == (K.height, K.width, 3) and image.std() > 20
    assert abs(K.cx / K.width - 0.5) < 0.05 and abs(K.cy / K.height - 0.5) < 0.06
    assert np.diff(sequence.stamps) == pytest.approx(0.1, abs=0.01)
    assert sequence.camera_height_m == height_m
    if length_m is None:
        return
    assert sequence.reference is not None and len(sequence.reference) == frames
    steps = np.linalg.norm(np.diff(sequence.reference[:, :3, 3], axis=0), axis=1)
    assert steps.sum() == pytest.approx(length_m, abs=1)


def test_roots_list_their_sequences(data_root: Path):
    assert list(sequence_kinds(data_root / "kitti_odometry")) == ["00", "02", "05"]
    assert list(sequence_kinds(data_root / "kitti_raw")) == ["2011_09_26_drive_0013"]


def test_raw_drive_goes_forward_and_smoothly(data_root: Path):
    sequence = open_sequence(data_root / "kitti_raw")
    assert (sequence.intrinsics.width, sequence.intrinsics.height) == (828, 250)
    assert sequence.intrinsics.fx == pytest.approx(721.5377 * 2 / 3)
    assert sequence.reference is not None and se3.is_se3(sequence.reference)
    increments = se3.invert(sequence.reference[:-1]) @ sequence.reference[1:]
    t = increments[:, :3, 3]
    assert (t[:, 2] / np.linalg.norm(t, axis=1) > 0.995).all()
    speed = np.linalg.norm(t, axis=1) / np.diff(sequence.stamps)
    assert np.abs(np.diff(speed)).max() < 0.5  # m/s from one frame to the next
    assert sequence.has_scan(47) and not sequence.has_scan(48)


def test_lidar_lands_on_the_image(data_root: Path):
    """Road points in front of the car project below the horizon, at the camera's height."""
    sequence = open_sequence(data_root / "kitti_raw")
    assert sequence.T_camera_lidar is not None
    points = se3.apply(sequence.T_camera_lidar, sequence.scan(0))
    road = points[(np.abs(points[:, 0]) < 2) & (points[:, 2] > 6) & (points[:, 2] < 12)]
    assert np.median(road[:, 1]) == pytest.approx(1.65, abs=0.15)
