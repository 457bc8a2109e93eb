"""The map of a run: its files and its numbers."""

from __future__ import annotations

import logging
from dataclasses import asdict
from typing import Any

from slam.evaluation.double_walls import double_wall_share
from slam.frames import Sequence
from slam.mapping.map import TsdfMap
from slam.mapping.submap import remove_submaps
from slam.mapping.surface import MapSurface, positions
from slam.pipeline.estimate import Estimate
from slam.results.double_walls import AT_LOOPS, double_walls_at_loops
from slam.results.folder import RunFolder
from slam.results.map_error import map_errors, no_map_errors
from slam.results.summary import null
from slam.runtime.errors import EmptyMapError
from slam.runtime.progress import Progress
from slam.runtime.run_files import MAP_CLOUD, MAP_MESH, SUBMAPS

logger = logging.getLogger(__name__)


def write_map(
    folder: RunFolder, result: Estimate, sequence: Sequence, progress: Progress | None = None
) -> dict[str, Any]:
    """Merge the submaps, write mesh and cloud, and give the numbers of the map; an empty map gives a reason.

    Raises:
        SlamError: a file cannot be written; finished submaps stay.
    """
    if result.map is None:
        return _no_map("fusion is switched off (mapping.enabled)")
    try:
        with result.stopwatch.stage("mesh"):
            surface = result.map.surface(progress)
    except EmptyMapError as error:
        logger.warning("no map: %s", error)
        remove_submaps(folder.path / SUBMAPS)
        return _no_map(str(error))
    with result.stopwatch.stage("mesh"):
        surface.write_mesh(folder.path / MAP_MESH)
        surface.write_cloud(folder.path / MAP_CLOUD)
    walls = _double_walls(surface, result.map, result)
    remove_submaps(folder.path / SUBMAPS)
    errors = map_errors(lambda: (positions(piece) for piece in surface.cloud_pieces()), result, sequence)
    return asdict(result.map.statistics()) | walls | errors


def _double_walls(surface: MapSurface, tsdf_map: TsdfMap, result: Estimate) -> dict[str, Any]:
    """Their distances are metres; without these a reason."""
    if not result.scale.is_metric:
        reason = "lengths are not in metres"
        return null("double_wall_share", reason) | null(AT_LOOPS, reason)
    at_loops = double_walls_at_loops(tsdf_map, result.loops, result.odometry, result.optimised)
    return {"double_wall_share": double_wall_share(surface.meshes())} | at_loops


def _no_map(reason: str) -> dict[str, Any]:
    names = ("triangles", "points", "blocks", "submaps", "filters", "floater_share", "double_wall_share")
    sizes = {key: value for name in (*names, AT_LOOPS) for key, value in null(name, reason).items()}
    return sizes | no_map_errors(reason)
