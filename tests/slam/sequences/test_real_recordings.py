from pathlib import Path

import numpy as np
import pytest

from slam.geometry import se3
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


@pytest.mark.parametrize("path, name, frames, length_m, height_m", RECORDINGS)
def test_opens(
    data_root: Path, path: str, name: str | None, frames: int, length_m: float | None, height_m
) -> None:
    sequence = open_sequence(data_root / path, name, None, None)
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


def test_roots_list_their_sequences(data_root: Path) -> None:
    assert list(sequence_kinds(data_root / "kitti_odometry")) == ["00", "02", "05"]
    assert list(sequence_kinds(data_root / "kitti_raw")) == ["2011_09_26_drive_0013"]


def test_raw_drive_goes_forward_and_smoothly(data_root: Path) -> None:
    sequence = open_sequence(data_root / "kitti_raw", None, None, None)
    assert (sequence.intrinsics.width, sequence.intrinsics.height) == (828, 250)
    assert sequence.intrinsics.fx == pytest.approx(721.5377 * 2 / 3)
    assert sequence.reference is not None and se3.is_se3(sequence.reference)
    increments = se3.invert(sequence.reference[:-1]) @ sequence.reference[1:]
    t = increments[:, :3, 3]
    assert (t[:, 2] / np.linalg.norm(t, axis=1) > 0.995).all()
    speed = np.linalg.norm(t, axis=1) / np.diff(sequence.stamps)
    assert np.abs(np.diff(speed)).max() < 0.5  # m/s from one frame to the next
    assert sequence.has_scan(47) and not sequence.has_scan(48)


def test_lidar_lands_on_the_image(data_root: Path) -> None:
    """Road points in front of the car project below the horizon, at the camera's height."""
    sequence = open_sequence(data_root / "kitti_raw", None, None, None)
    assert sequence.T_camera_lidar is not None
    points = se3.apply(sequence.T_camera_lidar, sequence.scan(0))
    road = points[(np.abs(points[:, 0]) < 2) & (points[:, 2] > 6) & (points[:, 2] < 12)]
    assert np.median(road[:, 1]) == pytest.approx(1.65, abs=0.15)
