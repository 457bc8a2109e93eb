"""The true surface beside a recording: a mesh in the frame of its first true pose, as the simulator writes it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from slam.formats.ply import read_ply
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.simulation.surface import distances, scene_of


def distance_to_mesh(path: Path) -> Callable[[FloatArray], FloatArray] | None:
    """Distances from points ``(M, 3)`` to a mesh, which is read when they are first asked for; None without a file.

    The distances raise ``SequenceError`` where the file is no mesh.
    """
    if not path.is_file():
        return None

    @functools.cache
    def scene() -> object:
        mesh = read_ply(path)
        if mesh.triangles is None:
            raise SequenceError(f"{path} has no triangles: simulate again, or remove it")
        return scene_of(mesh.points.astype(np.float32), mesh.triangles.astype(np.uint32))

    return lambda points: distances(scene(), points)
