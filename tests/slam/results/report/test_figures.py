"""A thinned map stays the same surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import slam.results.report.figures
from slam.formats.ply import Ply, write_ply
from slam.geometry.se3 import FloatArray
from slam.results.report.figures import thinned_mesh


@pytest.fixture
def path(plain: Ply, tmp_path: Path) -> Path:
    write_ply(tmp_path / "map_mesh.ply", plain)
    return tmp_path / "map_mesh.ply"


def area(points: FloatArray, triangles: NDArray[np.int64]) -> float:
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


@pytest.mark.parametrize("most", [0, 1_000_000])
def test_a_thinned_map_keeps_its_surface_and_colours(
    path: Path, monkeypatch: pytest.MonkeyPatch, most: int
):
    """By cells first, as a large one, and by quadric errors alone."""
    monkeypatch.setattr(slam.results.report.figures, "_MOST_TRIANGLES", most)
    all_points, all_colours, every = thinned_mesh(path, 100_000)
    points, colours, triangles = thinned_mesh(path, 2000)
    assert 1000 < len(triangles) <= 2000 < len(every)
    assert triangles.max() < len(points) == len(colours)
    inner = points[abs(points[:, [0, 2]]).max(axis=1) < 70.0]
    assert np.allclose(inner[:, 1], 1.65)
    assert area(points, triangles) == pytest.approx(area(all_points, every), rel=0.1)
    assert colours.mean(axis=0) == pytest.approx(all_colours.mean(axis=0), abs=12.0)
