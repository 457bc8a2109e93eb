"""KITTI's folders, by the names of both kinds of data set."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from erfsfm.common.errors import DataError
from erfsfm.common.readers.kitti import (
    CalibrationFile,
    drive_name,
    find_drives,
    find_odometry_root,
    odometry_camera,
)
from slam.geometry import se3
from slam.geometry.se3 import invert


@pytest.mark.parametrize("given", ["root[1]", "root[1]/dataset", "root[1]/dataset/sequences"])
def test_odometry_roots(tmp_path: Path, given: str):
    sequences = tmp_path / "root[1]/dataset/sequences"
    for name, camera in (("10", "image_3"), ("2", "image_0"), ("00", "")):
        (sequences / name / camera).mkdir(parents=True)
        if camera:
            (sequences / name / camera / "000000.png").write_bytes(b"")
    root = find_odometry_root(tmp_path / given)
    assert (root.base.name, root.names(), len(root.folders())) == ("dataset", ["2", "10"], 3)
    assert [odometry_camera(sequences / name) for name in ("10", "2", "00")] == [3, 0, None]
    assert root.recording_name("10") == "kitti_odometry/10"
    (root.base / "simulation.json").write_text('{"seed": 5}')
    assert (root.simulation_seed(), root.recording_name("10")) == (5, "simulated/5")
    assert find_odometry_root(tmp_path / "sequences") is None


def test_drives(tmp_path: Path):
    date = tmp_path / "2011_09_26"
    for name in (
        "2011_09_26_drive_0002_sync",
        "2011_09_26_drive_0001_sync",
        "2011_09_26_drive_0003_extract",
        "other",
    ):
        (date / name).mkdir(parents=True)
    names = ["2011_09_26_drive_0001", "2011_09_26_drive_0002"]
    assert list(find_drives(tmp_path)) == list(find_drives(date)) == names
    assert find_drives(date / "2011_09_26_drive_0001_sync") == {
        names[0]: date / "2011_09_26_drive_0001_sync"
    }
    assert find_drives(date / "other") == {}
    assert drive_name("2011_09_26/2011_09_26_drive_0001_sync") == names[0]
    with pytest.raises(DataError, match="is not rectified"):
        find_drives(date / "2011_09_26_drive_0003_extract")


@pytest.fixture
def calibration(tmp_path: Path):
    def write(text: str) -> CalibrationFile:
        (tmp_path / "calib.txt").write_text(text)
        return CalibrationFile(tmp_path / "calib.txt")

    return write


def test_lever_arm_by_hand(calibration):
    """KITTI's own colour camera: P2's column over the focal length is 6 cm, so camera 2 is 6 cm LEFT of 0."""
    text = "P2: 718.856 0 607.1928 45.38225 0 718.856 185.2157 -0.1130887 0 0 1 0.003779761"
    file = calibration(text)
    T_camera_cam0 = file.T_camera_cam0("P2")
    z = 0.003779761
    assert T_camera_cam0[:3, 3] == pytest.approx(
        [(45.38225 - 607.1928 * z) / 718.856, (-0.1130887 - 185.2157 * z) / 718.856, z]
    )
    T_cam0_camera = invert(T_camera_cam0)
    assert T_cam0_camera[0, 3] == pytest.approx(-0.0599, abs=1e-4)
    # reference is P itself: it projects a point of camera 0 to where K projects the translated point
    point_cam0 = np.array([1.0, -0.5, 8.0])
    P = file.matrix("P2", (3, 4))
    by_P = P @ [*point_cam0, 1.0]
    by_K = P[:, :3] @ se3.apply(se3.invert(T_cam0_camera), point_cam0[None])[0]
    assert by_K == pytest.approx(by_P)
