"""The map of a run: its files and its numbers."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.errors import SlamError
from slam.frames import Sequence
from slam.pipeline.batch import SlamResult
from slam.results.folder import RunFolder
from slam.results.map_error import map_errors, no_map_errors
from slam.results.summary import null

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Surface:
    """The map as points for the report, and its numbers."""

    summary: dict[str, Any]
    points: NDArray[np.float64] | None = None
    colours: NDArray[np.float64] | None = None


def write_map(folder: RunFolder, result: SlamResult, sequence: Sequence) -> Surface:
    """Write mesh and cloud; an empty map gives a reason and no error.

    Raises:
        RunError: a file cannot be written.
    """
    if result.map is None:
        return Surface(_no_map("fusion is switched off (mapping.enabled)"))
    try:
        result.map.mesh(), result.map.cloud()
    except SlamError as error:
        logger.warning("no map: %s", error)
        return Surface(_no_map(str(error)))
    result.map.write_mesh(folder.path / "map_mesh.ply")
    result.map.write_cloud(folder.path / "map_cloud.ply")
    cloud = result.map.cloud()
    errors = map_errors(cloud.points_world, result, sequence)
    return Surface(asdict(result.map.statistics()) | errors, cloud.points_world, cloud.colours)


def _no_map(reason: str) -> dict[str, Any]:
    sizes = {key: value for name in ("triangles", "points", "blocks") for key, value in null(name, reason).items()}
    return sizes | no_map_errors(reason)
