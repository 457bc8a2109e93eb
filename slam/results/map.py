"""The map of a run: its files and its numbers."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.errors import EmptyMapError
from slam.evaluation.double_walls import double_wall_share
from slam.frames import Sequence
from slam.mapping.submap import FOLDER as SUBMAPS
from slam.mapping.submap import remove_submaps
from slam.mapping.surface import MapSurface, colours, positions
from slam.pipeline.batch import Progress, SlamResult
from slam.results.folder import RunFolder
from slam.results.map_error import map_errors, no_map_errors
from slam.results.summary import null

logger = logging.getLogger(__name__)

_MOST_DRAWN = 500_000


@dataclass(frozen=True)
class Surface:
    """The map as points for the report, and its numbers."""

    summary: dict[str, Any]
    points: NDArray[np.float64] | None = None
    colours: NDArray[np.float64] | None = None


def write_map(folder: RunFolder, result: SlamResult, sequence: Sequence, progress: Progress | None = None) -> Surface:
    """Merge the submaps, write mesh and cloud, remove the submaps; an empty map gives a reason and no error.

    Raises:
        SlamError: a file cannot be written; finished submaps stay.
    """
    if result.map is None:
        return Surface(_no_map("fusion is switched off (mapping.enabled)"))
    try:
        with result.stopwatch.stage("mesh"):
            surface = result.map.surface(progress)
    except EmptyMapError as error:
        logger.warning("no map: %s", error)
        remove_submaps(folder.path / SUBMAPS)
        return Surface(_no_map(str(error)))
    with result.stopwatch.stage("mesh"):
        surface.write_mesh(folder.path / "map_mesh.ply")
        surface.write_cloud(folder.path / "map_cloud.ply")
    remove_submaps(folder.path / SUBMAPS)
    walls = {"double_wall_share": double_wall_share(surface.meshes())}
    errors = map_errors(lambda: (positions(piece) for piece in surface.cloud_pieces()), result, sequence)
    points, colours = _thinned(surface)
    return Surface(asdict(result.map.statistics()) | walls | errors, points, colours)


def _thinned(surface: MapSurface) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Some of the points for pictures, with their colours."""
    step = -(-surface.points // _MOST_DRAWN)
    drawn = np.concatenate([piece[::step] for piece in surface.cloud_pieces()])
    return positions(drawn), colours(drawn)


def _no_map(reason: str) -> dict[str, Any]:
    names = ("triangles", "points", "blocks", "submaps", "filters", "floater_share", "double_wall_share")
    sizes = {key: value for name in names for key, value in null(name, reason).items()}
    return sizes | no_map_errors(reason)
