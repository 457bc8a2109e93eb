"""Clouds and meshes are read as they are written here and by Open3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from meshes import coloured_ply

from slam.formats.ply import read_ply, write_ply
from slam.runtime.imports import import_open3d

POINTS = np.array([[0.0, 0.5, 1.0], [1.25, -2.0, 3.0]])
COLOURS = np.array([[0, 128, 255], [10, 20, 30]], np.uint8)


def test_what_open3d_writes(tmp_path: Path):
    o3d = import_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    cloud.normals = o3d.utility.Vector3dVector(np.tile([0.0, 1.0, 0.0], (2, 1)))
    cloud.colors = o3d.utility.Vector3dVector(COLOURS / 255)
    o3d.io.write_point_cloud(str(tmp_path / "c.ply"), cloud)
    ply = read_ply(tmp_path / "c.ply")
    np.testing.assert_allclose(ply.points, POINTS)
    np.testing.assert_array_equal(ply.colours, COLOURS)


TRIANGLES = np.array([[0, 1, 0]])
NORMALS = np.tile([0.0, 0.6, 0.8], (2, 1))


@pytest.mark.parametrize("triangles", [None, TRIANGLES])
def test_what_is_written_reads_back_here_and_in_open3d(
    tmp_path: Path, triangles: np.ndarray | None
):
    path = tmp_path / "c.ply"
    write_ply(path, coloured_ply(POINTS, NORMALS, COLOURS / 255, triangles))
    ply = read_ply(path)
    np.testing.assert_array_equal(ply.columns(("x", "y", "z")), POINTS)
    np.testing.assert_array_equal(ply.columns(("nx", "ny", "nz")), NORMALS)
    np.testing.assert_array_equal(ply.colours, COLOURS)
    o3d = import_open3d()
    if triangles is None:
        assert ply.triangles is None
        np.testing.assert_array_equal(np.asarray(o3d.io.read_point_cloud(str(path)).points), POINTS)
    else:
        np.testing.assert_array_equal(ply.triangles, triangles)
        np.testing.assert_array_equal(
            np.asarray(o3d.io.read_triangle_mesh(str(path)).triangles), triangles
        )
