"""Clouds are read as Open3D writes them, and as others do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam.errors import RunError
from slam.formats.ply import read_ply_points
from slam.runtime.imports import import_open3d

POINTS = np.array([[0.0, 0.5, 1.0], [1.25, -2.0, 3.0]])
COLOURS = np.array([[0, 128, 255], [10, 20, 30]], np.uint8)


@pytest.mark.parametrize("text", [False, True])
def test_what_open3d_writes(tmp_path: Path, text: bool) -> None:
    o3d = import_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    cloud.normals = o3d.utility.Vector3dVector(np.tile([0.0, 1.0, 0.0], (2, 1)))
    cloud.colors = o3d.utility.Vector3dVector(COLOURS / 255)
    o3d.io.write_point_cloud(str(tmp_path / "c.ply"), cloud, write_ascii=text)
    points, colours = read_ply_points(tmp_path / "c.ply")
    np.testing.assert_allclose(points, POINTS)
    np.testing.assert_array_equal(colours, COLOURS)


def test_text_with_faces_and_no_colours(tmp_path: Path) -> None:
    lines = ["ply", "format ascii 1.0", "comment by hand", "element vertex 2"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", "0 0.5 1", "1.25 -2 3", "2 0 1"]
    (tmp_path / "c.ply").write_text("\n".join(lines) + "\n")
    points, colours = read_ply_points(tmp_path / "c.ply")
    np.testing.assert_allclose(points, POINTS)
    assert (colours == 128).all()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"ply\nformat binary_big_endian 1.0\nend_header\n"])
def test_what_is_no_ply_is_one_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "c.ply").write_bytes(content)
    with pytest.raises(RunError, match=r"c\.ply is no PLY that can be read"):
        read_ply_points(tmp_path / "c.ply")


def test_a_cloud_that_breaks_off_is_one_error(tmp_path: Path) -> None:
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 5\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    (tmp_path / "c.ply").write_bytes(header.encode() + POINTS.tobytes())
    with pytest.raises(RunError, match="no PLY that can be read"):
        read_ply_points(tmp_path / "c.ply")
