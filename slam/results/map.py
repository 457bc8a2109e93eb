"""The map of a run: its files and its metrics."""

from __future__ import annotations

import logging
from dataclasses import asdict

from slam.evaluation.double_walls import double_wall_share
from slam.frames import Sequence
from slam.mapping.submap import remove_submaps
from slam.mapping.surface import positions
from slam.pipeline.estimate import Estimate
from slam.results.folder import RunFolder
from slam.results.map_error import map_errors
from slam.results.metrics import MapMetrics
from slam.runtime.errors import EmptyMapError
from slam.runtime.progress import Progress
from slam.runtime.run_files import MAP_CLOUD, MAP_MESH, SUBMAPS
from slam.runtime.storage.record import Missing

logger = logging.getLogger(__name__)


def write_map(folder: RunFolder, result: Estimate, sequence: Sequence, progress: Progress | None = None) -> MapMetrics:
    """Merge the submaps, write mesh and cloud, and give the metrics of the map; an empty map gives a reason.

    Raises:
        SlamError: a file cannot be written; finished submaps stay.
    """
    if result.map is None:
        return MapMetrics.missing("fusion is switched off (mapping.enabled)")
    try:
        with result.stopwatch.stage("mesh"):
            surface = result.map.surface(progress)
    except EmptyMapError as error:
        logger.warning("no map: %s", error)
        remove_submaps(folder.path / SUBMAPS)
        return MapMetrics.missing(str(error))
    with result.stopwatch.stage("mesh"):
        surface.write_mesh(folder.path / MAP_MESH)
        surface.write_cloud(folder.path / MAP_CLOUD)
    share = double_wall_share(surface.meshes()) if result.scale.is_metric else Missing("lengths are not in metres")
    remove_submaps(folder.path / SUBMAPS)
    errors = map_errors(lambda: (positions(piece) for piece in surface.cloud_pieces()), result, sequence)
    return MapMetrics(**asdict(result.map.statistics()), double_wall_share=share, **dict(errors))
