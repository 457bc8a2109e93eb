"""A map for the run folder of the tests: a checkered plain with a red wall around it."""

from __future__ import annotations

import numpy as np
import pytest
from meshes import coloured_ply

from slam.formats.ply import Ply, write_ply
from slam.formats.trajectory import Trajectory
from slam.results.folder import RunFolder
from slam.results.report.figures import MapView, map_view

HALF_M, STEP_M, GROUND_M = 80.0, 2.0, 1.65


@pytest.fixture(scope="session")
def plain() -> Ply:
    """160 x 160 m about the drive of ``make_run``, y down; checks of 10 m, dark and light; the wall is 8 m high."""
    side = np.arange(-HALF_M, HALF_M + STEP_M, STEP_M)
    x, z = np.meshgrid(side, side)
    rim = np.maximum(abs(x), abs(z)) == HALF_M
    points = np.stack([x, np.where(rim, GROUND_M - 8.0, GROUND_M), z], axis=-1).reshape(-1, 3)
    light = (np.floor(points[:, [0, 2]] / 10.0).sum(axis=1) % 2 == 0)[:, None]
    colours = np.where(light, [[0.8, 0.8, 0.7]], [[0.2, 0.3, 0.2]])
    colours[rim.ravel()] = [0.9, 0.1, 0.1]
    corner = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (
        part.ravel()
        for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:])
    )
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])
    return coloured_ply(points, np.tile([0.0, -1.0, 0.0], (len(points), 1)), colours, triangles)


@pytest.fixture(scope="session")
def view(plain: Ply, tmp_path_factory: pytest.TempPathFactory) -> MapView:
    """The plain with a drive straight through it."""
    folder = RunFolder(tmp_path_factory.mktemp("map"))
    write_ply(folder.path / "map_mesh.ply", plain)
    T_world_camera = np.tile(np.eye(4), (60, 1, 1))
    T_world_camera[:, 2, 3] = np.arange(60.0)
    folder.write_trajectory("optimised", Trajectory(np.arange(60.0), T_world_camera))
    found = map_view(folder, 2000)
    assert found is not None
    return found
