"""A coloured strip of surface, and a run whose images are on disk."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from meshes import coloured_ply

from slam.formats.ply import Ply, write_ply
from slam.formats.trajectory import Trajectory
from slam.frames import Intrinsics
from slam.geometry.se3 import FloatArray, chain, from_rotation_vector
from slam.loops.places import Places
from slam.results.folder import RunFolder
from slam.runtime.files import PLACES

CAMERA = Intrinsics(80, 48, 60.0, 61.0, 40.5, 22.25)
FRAMES = 8


def wavy(
    rows: int = 30, columns: int = 20, pitch: float = 0.1
) -> tuple[FloatArray, np.ndarray[Any, Any]]:
    """Points of a sheet and its triangles."""
    i, j = (each.ravel() for each in np.mgrid[:rows, :columns])
    points = np.column_stack([j * pitch, 1.5 + 0.02 * np.sin(0.7 * i + j), 2 + i * pitch]).astype(
        np.float32
    )
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    halves = [
        [corner, corner + 1, corner + columns],
        [corner + 1, corner + columns + 1, corner + columns],
    ]
    triangles = np.concatenate([np.stack(half, axis=1) for half in halves])
    return points.astype(np.float64), triangles


@pytest.fixture
def sheet() -> Ply:
    """A mesh of 600 vertices with normals and random colours."""
    points, triangles = wavy()
    colours = np.random.default_rng(3).integers(0, 256, points.shape) / 255.0
    return coloured_ply(points, np.tile([0.0, -1.0, 0.0], (len(points), 1)), colours, triangles)


@pytest.fixture
def make_recorded(
    tmp_path: Path, make_run: Callable[..., RunFolder], sheet: Ply
) -> Callable[..., RunFolder]:
    """Builds a run of a folder of images: eight frames, of which ``broken`` cannot be read."""

    def make(broken: tuple[int, ...] = (), bridged: tuple[int, ...] = ()) -> RunFolder:
        images = tmp_path / "drive"
        images.mkdir()
        for k in range(FRAMES):
            shade = np.full((CAMERA.height, CAMERA.width, 3), (10 * k, 20 * k, 30 * k), np.uint8)
            cv2.imwrite(str(images / f"{k:02d}.png"), shade)
            if k in broken:
                (images / f"{k:02d}.png").write_bytes(b"no image")
        (images / "camera.yaml").write_text(
            f"width: {CAMERA.width}\nheight: {CAMERA.height}\nfx: {CAMERA.fx}\nfy: {CAMERA.fy}\n"
            f"cx: {CAMERA.cx}\ncy: {CAMERA.cy}\nfps: 10\n"
        )
        metrics = {
            "schema": 1,
            "status": "ok",
            "provenance": {"recording": {"dataset": str(images)}},
            "sequence": {
                "frames": FRAMES,
                "bridged": [{"first": k, "last": k, "reason": "blank"} for k in bridged],
            },
            "scale": {"mode": "camera-height", "value": 1.0},
        }
        folder = make_run("recorded", metrics)
        turns = np.tile([0.0, 0.02, 0.0], (FRAMES - 1, 1))
        poses = chain(from_rotation_vector(turns, np.tile([0.01, 0.0, 0.1], (FRAMES - 1, 1))))
        folder.write_trajectory("optimised", Trajectory(0.1 * np.arange(FRAMES), poses))
        write_ply(folder.path / "map_mesh.ply", sheet)
        write_ply(folder.path / "map_cloud.ply", Ply(sheet.vertices))
        folder.write(PLACES, Places(CAMERA, (), np.zeros((0, 4, 4))).write)
        return folder

    return make
