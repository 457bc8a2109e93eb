"""The Eigen protocol with oracle networks, its two scales and its fidelities."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.common.readers.frame_range import overlapping
from erfsfm.config import NetworkConfig
from erfsfm.evaluation.eigen import RawFrame, displacements, eigen_protocol, lidar_depth, read_split
from erfsfm.inference import DepthPosePredictor
from erfsfm.model_record import ModelRecord

DRIVE = "2011_09_26_drive_0099"
Write = Callable[..., Path]


class Oracle:
    """Sees the wall of ``write_drive`` at 20 m and its 1 m a frame, in units of ``unit`` metres."""

    sources = 4

    def __init__(self, unit: float = 2.0, depth_m: float = 20.0, seen: Sequence[str] = ()) -> None:
        self.unit, self.depth_m, self.seen = unit, depth_m, seen
        self.record = ModelRecord(network=NetworkConfig(height=32, width=64), trained_on=list(seen))
        self.asked: list[tuple[int, ...]] = []

    def depth(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.asked.append(image.shape)
        return np.full(image.shape[:2], self.depth_m / self.unit, np.float32)

    def poses(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float64]:
        assert [int(image[0, 0, 0]) for image in images] == sorted(
            int(image[0, 0, 0]) for image in images
        )
        assert len(images) == 5
        T_source_target = np.tile(np.eye(4), (4, 1, 1))
        T_source_target[:, 2, 3] = np.array([2, 1, -1, -2]) / self.unit
        return T_source_target

    def leaks(self, names: Sequence[str]) -> list[str]:
        return overlapping(names, self.seen)


@pytest.fixture
def split(tmp_path: Path) -> str:
    path = tmp_path / "split.txt"
    path.write_text(
        f"{DRIVE} 0\n2011_09_26/{DRIVE}_sync/image_02/data/0000000004.png\n\n{DRIVE}_sync 8 l\n"
    )
    return str(path)


@pytest.mark.parametrize("fidelity", ["default", "paper"])
def test_both_scales(tmp_path: Path, write_drive: Write, split: str, fidelity: str):
    root = write_drive(tmp_path / "raw")
    oracle = Oracle()
    median, pose, flat = eigen_protocol(oracle, root, split, fidelity, allow_leak=False)
    assert (median["scaling"], pose["scaling"]) == ("gt-median", "pose")
    for row in (median, pose):
        assert row["scale"] == pytest.approx(2, rel=1e-5)
        assert row["abs_rel"] == pytest.approx(0, abs=1e-5)
        assert (row["images"], row["left_out"], row["leak"]) == (3, 0, False)
    assert flat["method"] == "flat road" and flat["abs_rel"] > 0.05
    assert set(oracle.asked) == {(32, 64, 3) if fidelity == "paper" else (64, 96, 3)}


def test_a_wrong_unit_of_motion_affects_the_pose_row_alone(
    tmp_path: Path, write_drive: Write, split: str
):
    root = write_drive(tmp_path / "raw", speed=12.0)
    median, pose, _ = eigen_protocol(Oracle(), root, split, "default", allow_leak=False)
    assert median["abs_rel"] == pytest.approx(0, abs=1e-5)
    assert pose["abs_rel"] == pytest.approx(0.2, abs=1e-5)


def test_clipping_is_what_fidelity_changes(tmp_path: Path, write_drive: Write, split: str):
    """200 units are clipped to 80 before scaling (paper), or 20 m after it (default)."""
    root = write_drive(tmp_path / "raw")
    far = Oracle(unit=0.1)
    assert eigen_protocol(far, root, split, "default", False)[1]["abs_rel"] == pytest.approx(
        0, abs=1e-5
    )
    assert eigen_protocol(far, root, split, "paper", False)[1]["abs_rel"] == pytest.approx(
        1 - 80 * 0.1 / 20, abs=1e-5
    )


def test_a_car_that_stands_still(tmp_path: Path, write_drive: Write, split: str):
    root = write_drive(tmp_path / "raw", speed=0.0)
    median, pose, _ = eigen_protocol(Oracle(), root, split, "default", allow_leak=False)
    assert (median["images"], pose["images"], pose["abs_rel"]) == (3, 0, None)
    assert "stands still" in pose["abs_rel_reason"]
    pose = eigen_protocol(Oracle(), root, split, "paper", allow_leak=False)[1]
    assert (pose["images"], pose["abs_rel"], pose["rmse_log"]) == (3, pytest.approx(1), None)
    assert pose["rmse_log_reason"] == "an image has no scale"
    assert pose["scale_spread"] is None


def test_leaks_are_refused_by_frame(tmp_path: Path, write_drive: Write, split: str):
    root = write_drive(tmp_path / "raw")
    seen = Oracle(seen=[f"kitti_raw/{DRIVE}[4:5]"])
    with pytest.raises(DataError, match=rf"leak: .*{DRIVE}\[4:5\]"):
        eigen_protocol(seen, root, split, "default", allow_leak=False)
    assert eigen_protocol(seen, root, split, "default", allow_leak=True)[0]["leak"] is True
    eigen_protocol(
        Oracle(seen=[f"kitti_raw/{DRIVE}[5:8]"]), root, split, "default", allow_leak=False
    )


def test_the_eigen_list(tmp_path: Path):
    """697 frames of 28 drives; of the four that are odometry sequences, one frame lies beyond its sequence's end."""
    frames = read_split("eigen", tmp_path)
    assert len(frames) == len(set(frames)) == 697
    drives = Counter(frame.drive for frame in frames)
    assert len(drives) == 28
    assert drives.pop("2011_09_26_drive_0048") == 22
    assert set(drives.values()) == {25}
    assert {frame.camera for frame in frames} == {2}
    odometry = [f"kitti_odometry/{sequence:02d}" for sequence in range(11)]
    assert len(overlapping([frame.name for frame in frames], odometry)) == 99
    assert len(overlapping([f"kitti_raw/{frame.drive}" for frame in frames], odometry)) == 100


@pytest.mark.data
def test_shipped_weights_on_a_real_drive(data_root: Path, tmp_path: Path):
    """Never seen in training: better than the baseline, and both fidelities agree where clipping does not matter."""
    (tmp_path / "split.txt").write_text(
        "".join(f"2011_09_26_drive_0013 {i}\n" for i in (5, 25, 45))
    )
    predictor = DepthPosePredictor.from_weights("default")
    root, split = data_root / "kitti_raw", str(tmp_path / "split.txt")
    rows = {
        f: eigen_protocol(predictor, root, split, f, allow_leak=False) for f in ("default", "paper")
    }
    assert rows["default"][0]["abs_rel"] < 0.4
    assert rows["paper"][0]["abs_rel"] == pytest.approx(rows["default"][0]["abs_rel"], rel=0.02)
    assert 5 < rows["default"][1]["scale"] < 200


PointsAt = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float32]]


@pytest.mark.parametrize("fidelity", ["default", "paper"])
def test_pixels_count_from_one_and_the_nearest_wins(
    tmp_path: Path, write_drive: Write, points_at: PointsAt, fidelity: str
):
    places = np.array([[10.0, 20.0], [10.4, 19.6], [96.0, 64.0], [97.0, 5.0], [0.4, 5.0]])
    points = points_at(places, np.array([30.0, 12.0, 50.0, 7.0, 7.0]))
    behind = np.array([[-5, 0, 0, 1]], np.float32)
    frame = RawFrame(write_drive(tmp_path, points=np.concatenate([points, behind])), DRIVE, 3)
    depth = lidar_depth(frame, (64, 96), fidelity)
    assert depth.shape == (64, 96)
    assert depth.dtype == np.float32
    known = {(int(r), int(c)): float(depth[r, c]) for r, c in zip(*np.nonzero(depth))}
    assert known == pytest.approx({(19, 9): 12.0, (63, 95): 50.0}, rel=1e-6)


def test_the_papers_numbering_confuses_the_ends_of_rows(
    tmp_path: Path, write_drive: Write, points_at: PointsAt
):
    """The last pixel of row 9 and the first of row 10 share a number; the one met first gets the nearest depth."""
    points = points_at(np.array([[96.0, 10.0], [1.0, 11.0]]), np.array([40.0, 15.0]))
    frame = RawFrame(write_drive(tmp_path, points=points), DRIVE, 0)
    default, paper = (lidar_depth(frame, (64, 96), fidelity) for fidelity in ("default", "paper"))
    assert (default[9, 95], default[10, 0]) == pytest.approx((40, 15))
    assert (paper[9, 95], paper[10, 0]) == pytest.approx((15, 15))


def test_displacements_are_trapezoids(tmp_path: Path, write_drive: Write):
    root = write_drive(tmp_path, speed=0.0)
    oxts = root / "2011_09_26" / f"{DRIVE}_sync/oxts/data"
    values = np.zeros(30)
    values[6] = 20.0  # northwards, in frame 5 alone: 0.1 s of mean 10 m/s on each side
    (oxts / "0000000005.txt").write_text(" ".join(map(str, values)))
    np.testing.assert_allclose(
        displacements(RawFrame(root, DRIVE, 4), [2, 3, 4, 5, 6]), [0, 0, 1, 2], atol=1e-5
    )


@pytest.mark.data
def test_a_real_scan(data_root: Path):
    """Fidelities differ at ends of rows alone; at the stored size depth is the same scene's."""
    root, drive = data_root / "kitti_raw", "2011_09_26_drive_0013"
    frame = RawFrame(root, drive, 7)
    paper = lidar_depth(frame, (375, 1242), "paper")
    assert (paper > 0).sum() > 5000
    default = lidar_depth(frame, (375, 1242))
    assert ((default > 0) == (paper > 0)).all()
    assert (np.abs(default - paper) > 1e-4).mean() < 1e-4, "they differ at ends of rows alone"
    small = lidar_depth(frame, (250, 828))
    assert np.median(small[small > 0]) == pytest.approx(np.median(default[default > 0]), rel=0.02)


@pytest.mark.data
def test_a_real_drive_moves_as_its_gps_does(data_root: Path):
    frame = RawFrame(data_root / "kitti_raw", "2011_09_26_drive_0013", 60)
    places = []
    for index in (58, 60):
        north, east = (
            np.radians(np.loadtxt(frame.folder / "oxts/data" / f"{index:010d}.txt")[:2]) * 6378137.0
        )
        places.append([north, east * np.cos(np.radians(49.0131))])
    gps = np.linalg.norm(np.subtract(*places))
    assert displacements(frame, frame.window(4))[0] == pytest.approx(gps, rel=0.05)
