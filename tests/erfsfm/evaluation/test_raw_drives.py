"""LiDAR depth and displacement of raw drives, by hand, by brute force and on a real drive."""

from __future__ import annotations

from collections import Counter
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


def _brute_force(root: Path, drive: str, index: int, size: tuple[int, int]) -> NDArray[np.float64]:
    """The benchmark's recipe point by point: facts of the reference code, in a loop."""
    rows = {}
    for name in ("calib_cam_to_cam", "calib_velo_to_cam"):
        for line in (root / drive[:10] / f"{name}.txt").read_text().splitlines():
            key, _, text = line.partition(":")
            rows[name, key] = text.split()

    def numbers(name: str, key: str) -> NDArray[np.float64]:
        return np.array([float(word) for word in rows[name, key]])

    rotation = numbers("calib_cam_to_cam", "R_rect_00").reshape(3, 3)
    P = numbers("calib_cam_to_cam", "P_rect_02").reshape(3, 4)
    R, t = numbers("calib_velo_to_cam", "R").reshape(3, 3), numbers("calib_velo_to_cam", "T")
    scan = np.fromfile(root / drive[:10] / f"{drive}_sync/velodyne_points/data/{index:010d}.bin", np.float32).reshape(
        -1, 4
    )
    found = []
    for x, y, z, _ in scan.astype(float):
        if x >= 0:
            u, v, w = P @ np.append(rotation @ (R @ (x, y, z) + t), 1)
            column, row = round(u / w) - 1, round(v / w) - 1
            if 0 <= column < size[1] and 0 <= row < size[0]:
                found.append((row, column, w))
    depth = np.zeros(size)
    for row, column, w in found:
        depth[row, column] = w
    keys = [row * (size[1] - 1) + column - 1 for row, column, _ in found]
    for key, count in Counter(keys).items():
        if count > 1:
            same = [point for point, other in zip(found, keys) if other == key]
            depth[same[0][0], same[0][1]] = min(w for _, _, w in same)
    return depth


@pytest.mark.data
def test_a_real_scan(data_root: Path) -> None:
    """At the original size paper fidelity is the benchmark's map; at the stored size depth is the same scene's."""
    root, drive = data_root / "kitti_raw", "2011_09_26_drive_0013"
    frame = RawFrame(root, drive, 7)
    paper = lidar_depth(frame, (375, 1242), "paper")
    wanted = _brute_force(root, drive, 7, (375, 1242))
    np.testing.assert_allclose(paper, wanted, rtol=1e-6)
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
