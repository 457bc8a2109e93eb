"""LiDAR depth and displacement of raw drives, by hand, by brute force and on a real drive."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.evaluation.raw_drives import RawFrame, displacements, lidar_depth

DRIVE = "2011_09_26_drive_0099"
PointsAt = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float32]]
Write = Callable[..., Path]


@pytest.mark.parametrize("fidelity", ["default", "paper"])
def test_pixels_count_from_one_and_the_nearest_wins(
    tmp_path: Path, write_drive: Write, points_at: PointsAt, fidelity: str
) -> None:
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
) -> None:
    """The last pixel of row 9 and the first of row 10 share a number; the one met first gets the nearest depth."""
    points = points_at(np.array([[96.0, 10.0], [1.0, 11.0]]), np.array([40.0, 15.0]))
    frame = RawFrame(write_drive(tmp_path, points=points), DRIVE, 0)
    default, paper = (lidar_depth(frame, (64, 96), fidelity) for fidelity in ("default", "paper"))
    assert (default[9, 95], default[10, 0]) == pytest.approx((40, 15))
    assert (paper[9, 95], paper[10, 0]) == pytest.approx((15, 15))


def test_displacements_are_trapezoids(tmp_path: Path, write_drive: Write) -> None:
    root = write_drive(tmp_path, speed=0.0)
    oxts = root / "2011_09_26" / f"{DRIVE}_sync/oxts/data"
    values = np.zeros(30)
    values[6] = 20.0  # northwards, in frame 5 alone: 0.1 s of mean 10 m/s on each side
    (oxts / "0000000005.txt").write_text(" ".join(map(str, values)))
    np.testing.assert_allclose(displacements(RawFrame(root, DRIVE, 4), [2, 3, 4, 5, 6]), [0, 0, 1, 2], atol=1e-5)


@pytest.mark.data
def test_a_real_scan(data_root: Path) -> None:
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
def test_a_real_drive_moves_as_its_gps_does(data_root: Path) -> None:
    frame = RawFrame(data_root / "kitti_raw", "2011_09_26_drive_0013", 60)
    places = []
    for index in (58, 60):
        north, east = np.radians(np.loadtxt(frame.folder / "oxts/data" / f"{index:010d}.txt")[:2]) * 6378137.0
        places.append([north, east * np.cos(np.radians(49.0131))])
    gps = np.linalg.norm(np.subtract(*places))
    assert displacements(frame, frame.window(4))[0] == pytest.approx(gps, rel=0.05)
