"""The map of a run as a PLY file; of a run that was killed, what its finished submaps hold."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slam.config.sections import load_stored
from slam.mapping.submap import FOLDER, Submap, submap_paths
from slam.mapping.surface import MapSurface
from slam.results.folder import RunFolder
from slam.runtime.progress import Progress

logger = logging.getLogger(__name__)


def has_map(folder: RunFolder, what: str) -> bool:
    """Whether a run has a ``mesh`` or ``cloud``, or submaps of which one can be made."""
    return (folder.path / f"map_{what}.ply").is_file() or bool(submap_paths(folder.path / FOLDER))


@contextmanager
def map_file(folder: RunFolder, what: str, progress: Progress | None = None) -> Iterator[Path]:
    """The ``mesh`` or ``cloud`` of a run as a PLY file, which may be gone afterwards.

    Raises:
        SlamError: the run has neither it nor submaps, or these are damaged or hold no surface.
    """
    paths = submap_paths(folder.path / FOLDER)
    if (folder.path / f"map_{what}.ply").is_file() or not paths:
        yield folder.require(f"map_{what}.ply")
        return
    logger.warning("%s has no whole map: its %d finished submaps are used", folder.path, len(paths))
    settings = load_stored(folder.require("config.yaml"), "mapping").mapping
    voxel_size = float(Submap.read(paths[0]).voxel_size)  # which follows the scene where no metres were known
    surface = MapSurface(paths, settings.in_unit(voxel_size / settings.voxel_size_m), progress)
    with tempfile.TemporaryDirectory(prefix="erfsfm-slam-map-") as temporary:
        path = Path(temporary) / f"map_{what}.ply"
        (surface.write_mesh if what == "mesh" else surface.write_cloud)(path)
        yield path
