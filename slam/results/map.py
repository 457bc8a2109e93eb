"""The map of a run: its files and its numbers."""

from __future__ import annotations

import logging
from dataclasses import asdict
from typing import Any

from slam.errors import SlamError
from slam.frames import Sequence
from slam.pipeline.batch import SlamResult
from slam.results.folder import RunFolder
from slam.results.map_error import map_errors, no_map_errors
from slam.results.summary import null

logger = logging.getLogger(__name__)


def write_map(folder: RunFolder, result: SlamResult, sequence: Sequence) -> dict[str, Any]:
    """Write mesh and cloud, and give the numbers of the map; an empty map gives a reason and no error.

    Raises:
        RunError: a file cannot be written.
    """
    if result.map is None:
        return _no_map("fusion is switched off (mapping.enabled)")
    try:
        result.map.mesh(), result.map.cloud()
    except SlamError as error:
        logger.warning("no map: %s", error)
        return _no_map(str(error))
    result.map.write_mesh(folder.path / "map_mesh.ply")
    result.map.write_cloud(folder.path / "map_cloud.ply")
    errors = map_errors(result.map.cloud().points_world, result, sequence)
    return asdict(result.map.statistics()) | errors


def _no_map(reason: str) -> dict[str, Any]:
    sizes = {key: value for name in ("triangles", "points", "blocks") for key, value in null(name, reason).items()}
    return sizes | no_map_errors(reason)
