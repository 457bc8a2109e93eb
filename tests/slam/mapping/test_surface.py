"""The surface of one tile."""

from __future__ import annotations

from itertools import permutations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam.mapping import surface
from slam.mapping.surface import extract_tile


def test_the_order_of_vertices_in_one_place_is_that_of_their_triangles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Open3D's threads give them in any; here two triangles touch in a corner that each has for itself."""
    vertices = np.array([[1, 1, 1], [2, 1, 1], [1, 2, 1], [1, 1, 1], [0.5, 1, 1], [1, 1, 0.5]])
    triangles = np.array([[0, 1, 2], [3, 4, 5]])
    submaps: Any = SimpleNamespace(merged=lambda low, high: ())
    found = []
    for order in permutations(range(6)):
        place = np.argsort(order)
        monkeypatch.setattr(
            surface, "_extract", lambda *_, o=order, p=place: (vertices[list(o)], p[triangles])
        )
        mesh = extract_tile(submaps, np.zeros(3, dtype=np.int64), 0.1, 1.0)
        assert mesh is not None
        found.append((mesh.vertices, mesh.triangles))
    assert all(np.array_equal(v, found[0][0]) and np.array_equal(t, found[0][1]) for v, t in found)
    assert len({tuple(vertex) for vertex in found[0][0]}) == 5
