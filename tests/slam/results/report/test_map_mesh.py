"""A map is reduced without being read as a whole, and stays the same surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import slam.results.report.map_mesh
from slam.formats.ply import Ply, write_ply
from slam.results.report.map_mesh import MapMesh, MapMeshFile


@pytest.fixture
def file(plain: Ply, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> MapMeshFile:
    monkeypatch.setattr(slam.results.report.map_mesh, "_CHUNK", 1000)  # many pieces
    write_ply(tmp_path / "map_mesh.ply", plain)
    return MapMeshFile(tmp_path / "map_mesh.ply")


def area(mesh: MapMesh) -> float:
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def test_a_large_map_keeps_its_surface_and_colours(file: MapMeshFile) -> None:
    whole, mesh = file.reduced(100_000), file.reduced(4000)
    assert 1500 < len(mesh.triangles) < 5000 < len(whole.triangles)
    inner = mesh.points[abs(mesh.points[:, [0, 2]]).max(axis=1) < 70.0]
    assert np.allclose(inner[:, 1], 1.65)
    assert area(mesh) == pytest.approx(area(whole), rel=0.08)
    assert mesh.colours.mean(axis=0) == pytest.approx(whole.colours.mean(axis=0), abs=12.0)


def test_decimation_reaches_its_number_and_keeps_a_plain_flat(file: MapMeshFile) -> None:
    mesh = file.reduced(100_000).decimated(900)
    assert 500 < len(mesh.triangles) <= 900
    assert mesh.triangles.max() < len(mesh.points) == len(mesh.colours)
    assert area(mesh) == pytest.approx(area(file.reduced(100_000)), rel=0.1)
