"""The small records between the parts."""

from __future__ import annotations

import numpy as np

from slam.frames import Intrinsics, runs


def test_runs_of_frames() -> None:
    assert runs({7, 3, 4, 9, 8}) == [(3, 4), (7, 9)] and runs(()) == []


def test_rays_project_back_to_their_pixels() -> None:
    camera = Intrinsics(40, 30, 50.0, 55.0, 19.5, 14.0)
    grid = camera.pixel_grid()
    rays = camera.rays(grid)
    assert grid.shape == (30, 40, 2) and rays.shape == (30, 40, 3)
    np.testing.assert_allclose((rays @ camera.K.T)[..., :2], grid, atol=1e-12)
    assert (rays[..., 2] == 1.0).all()
