"""KITTI's folders, by the names of both kinds of data set."""

from __future__ import annotations

from pathlib import Path

import pytest

from erfsfm.common.errors import DataError
from erfsfm.common.readers.kitti import drive_name, find_drives, find_odometry_root, odometry_camera


@pytest.mark.parametrize("given", ["root[1]", "root[1]/dataset", "root[1]/dataset/sequences"])
def test_odometry_roots(tmp_path: Path, given: str) -> None:
    sequences = tmp_path / "root[1]/dataset/sequences"
    for name, camera in (("10", "image_3"), ("2", "image_0"), ("00", "")):
        (sequences / name / camera).mkdir(parents=True)
        if camera:
            (sequences / name / camera / "000000.png").write_bytes(b"")
    root = find_odometry_root(tmp_path / given)
    assert root is not None
    assert (root.base.name, root.names(), len(root.folders())) == ("dataset", ["2", "10"], 3)
    assert [odometry_camera(sequences / name) for name in ("10", "2", "00")] == [3, 0, None]
    assert root.recording_name("10") == "kitti_odometry/10"
    (root.base / "simulation.json").write_text('{"seed": 5}')
    assert (root.simulation_seed(), root.recording_name("10")) == (5, "simulated/5")
    assert find_odometry_root(tmp_path / "sequences") is None


def test_drives(tmp_path: Path) -> None:
    date = tmp_path / "2011_09_26"
    for name in ("2011_09_26_drive_0002_sync", "2011_09_26_drive_0001_sync", "2011_09_26_drive_0003_extract", "other"):
        (date / name).mkdir(parents=True)
    names = ["2011_09_26_drive_0001", "2011_09_26_drive_0002"]
    assert list(find_drives(tmp_path)) == list(find_drives(date)) == names
    assert find_drives(date / "2011_09_26_drive_0001_sync") == {names[0]: date / "2011_09_26_drive_0001_sync"}
    assert find_drives(date / "other") == {}
    assert drive_name("2011_09_26/2011_09_26_drive_0001_sync") == names[0]
    with pytest.raises(DataError, match="is not rectified"):
        find_drives(date / "2011_09_26_drive_0003_extract")
