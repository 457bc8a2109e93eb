"""Parts of a run as files for other programs."""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from erfsfm.common.progress import Progress, silent
from slam.commands.exports.colmap import write_model
from slam.commands.exports.nerfstudio import write_scene
from slam.commands.exports.occupancy import occupancy_grid
from slam.commands.exports.options import DEFAULT_RESOLUTION, R_UP_WORLDS, ExportOptions
from slam.commands.exports.parts import PARTS, check_options, check_target
from slam.commands.exports.raster import height_raster, write_raster
from slam.commands.exports.surface import prepared
from slam.config.sections import load_stored
from slam.formats.g2o import check_g2o
from slam.formats.gltf import write_gltf
from slam.formats.las import write_las
from slam.formats.ply import Ply, read_ply, rotated, write_ply
from slam.formats.ros_map import write_ros_map
from slam.formats.trajectory import Trajectory, write_kitti, write_tum
from slam.geometry import se3
from slam.mapping.submap import Submap, submap_paths
from slam.mapping.surface import MapSurface
from slam.results.folder import RunFolder
from slam.results.metrics import CAMERA_HEIGHTS, METRES
from slam.runtime.errors import RunError
from slam.runtime.run_files import CONFIG, ESTIMATE, GRAPH, MAP_CLOUD, MAP_MESH, SUBMAPS
from slam.runtime.storage.files import write_atomically
from slam.runtime.storage.record import known

logger = logging.getLogger(__name__)

_MAPS = {"mesh": MAP_MESH, "cloud": MAP_CLOUD}
_WRITERS = {".ply": write_ply, ".glb": write_gltf, ".gltf": write_gltf, ".las": write_las, ".laz": write_las}


def export(
    folder: RunFolder,
    what: str,
    output: Path,
    up: str = "y-down",
    options: ExportOptions | None = None,
    progress: Progress = silent,
) -> Path:
    """Write one part of a run, each file whole or not at all; missing parent folders are made.

    The part is read whole and checked before anything is written.

    Args:
        folder: the run.
        what: ``mesh`` (PLY or glTF by the end of ``output``), ``cloud`` (PLY, LAS or LAZ), ``trajectory`` (the
            optimised one: TUM where ``output`` ends in ``.tum`` or ``.tum.txt``, else KITTI), ``graph`` (g2o),
            ``colmap`` (a model), ``nerfstudio`` (images and ``transforms.json``), ``raster`` (heights
            and colours from above) or ``occupancy`` (a grid for ROS).
        output: the file; for ``colmap``, ``nerfstudio`` and ``raster`` the folder.
        up: ``y-down`` as the run has it; ``z``: x right, y ahead, z up; ``y-up``: x right, y up, z backwards. Cameras
            keep their own axes, only the world is rotated.
        options: what to do with the part on the way.
        progress: called with (stage, done, total).

    Returns:
        What was written.

    Raises:
        SlamError: an option that is unknown or has no effect, a part that the run lacks or that is damaged, images
            that are not found, or a file that cannot be written.
    """
    options = options or ExportOptions()
    check_options(what, up, options)
    check_target(folder, what, output)
    if what in _MAPS:
        _export_map(folder, what, output, up, options, progress)
    elif what == "trajectory":
        write = write_tum if output.name.endswith((".tum", ".tum.txt")) else write_kitti
        write(output, _trajectory(folder, up))
    elif what == "graph":
        source = folder.require(GRAPH)
        check_g2o(source)
        write_atomically(output, lambda path: shutil.copyfile(source, path), RunError)
    elif what in ("colmap", "nerfstudio"):
        _export_scene(folder, what, output, up, options, progress)
    elif what == "raster":
        _export_raster(folder, output, options, progress)
    else:
        return _export_occupancy(folder, output, options, progress)
    return output


def _export_map(
    folder: RunFolder, what: str, output: Path, up: str, options: ExportOptions, progress: Progress
) -> None:
    suffix, suffixes = output.suffix.lower(), PARTS[what].beginnings
    if suffix not in suffixes:
        named = ", ".join(suffixes)
        raise RunError(f"a {what} is written as {named}; got '{output.name}', give a name that ends in one of these")
    with _map_file(folder, what, progress) as source:
        ply = read_ply(source)
        if suffix == ".ply" and up == "y-down" and options == ExportOptions():
            write_atomically(output, lambda path: shutil.copyfile(source, path), RunError)
        else:
            _WRITERS[suffix](output, _rotated(prepared(ply, options), up))


def _export_scene(
    folder: RunFolder, what: str, output: Path, up: str, options: ExportOptions, progress: Progress
) -> None:
    trajectory, cloud = _trajectory(folder, up), _cloud(folder, up, options, progress)
    if what == "colmap":
        write_model(folder, output, trajectory, R_UP_WORLDS[up], cloud, options, progress)
    else:
        write_scene(folder, output, trajectory, cloud, options.dataset, progress)


def _export_raster(folder: RunFolder, output: Path, options: ExportOptions, progress: Progress) -> None:
    unit = folder.metrics().unit
    if options.origin is not None and unit != METRES:
        raise RunError(f"a place on the earth needs metres, but this run's lengths are in {unit}: leave --origin")
    mesh = _map(folder, "mesh", "z", options, progress)
    raster = height_raster(mesh, options.resolution or DEFAULT_RESOLUTION, options.origin)
    write_raster(output, raster, unit)


def _export_occupancy(folder: RunFolder, output: Path, options: ExportOptions, progress: Progress) -> Path:
    if output.suffix.lower() not in (".yaml", ".pgm"):
        raise RunError(f"an occupancy grid is a .yaml and a .pgm; got '{output.name}', give a name that ends in .yaml")
    unit = folder.metrics().unit
    if unit not in (METRES, CAMERA_HEIGHTS):
        raise RunError(f"heights above the road need metres or camera heights, but this run's lengths are in {unit}")
    mesh = _map(folder, "mesh", "z", options, progress)
    trajectory = _trajectory(folder, "z")
    resolution = options.resolution or DEFAULT_RESOLUTION
    grid = occupancy_grid(mesh, trajectory.T_world_camera, resolution, unit == METRES)
    written = output.with_suffix(".yaml")
    write_ros_map(written, grid.cells, grid.corner, grid.resolution, unit)
    return written


def _cloud(folder: RunFolder, up: str, options: ExportOptions, progress: Progress) -> Ply | None:
    """The cloud of the map, None where the run has neither it nor submaps of which it can be made."""
    if not (folder.path / MAP_CLOUD).is_file() and not submap_paths(folder.path / SUBMAPS):
        return None
    return _map(folder, "cloud", up, options, progress)


def _map(folder: RunFolder, what: str, up: str, options: ExportOptions, progress: Progress) -> Ply:
    """The mesh or cloud of the map as the options want it, in the given axes."""
    with _map_file(folder, what, progress) as source:
        return _rotated(prepared(read_ply(source), options), up)


@contextmanager
def _map_file(folder: RunFolder, what: str, progress: Progress) -> Iterator[Path]:
    """The ``mesh`` or ``cloud`` as a PLY file, which may be gone afterwards; of a killed run that of its submaps."""
    paths = submap_paths(folder.path / SUBMAPS)
    if (folder.path / _MAPS[what]).is_file() or not paths:
        yield folder.require(_MAPS[what])
        return
    logger.warning("%s has no whole map: its %d finished submaps are used", folder.path, len(paths))
    settings = load_stored(folder.require(CONFIG), "mapping").mapping
    voxel_size = float(Submap.read(paths[0]).voxel_size)  # which follows the scene where no metres were known
    surface = MapSurface(paths, settings.in_unit(voxel_size / settings.voxel_size_m), progress)
    with tempfile.TemporaryDirectory(prefix="erfsfm-slam-map-") as temporary:
        path = Path(temporary) / _MAPS[what]
        (surface.write_mesh if what == "mesh" else surface.write_cloud)(path)
        yield path


def _rotated(ply: Ply, up: str) -> Ply:
    return ply if up == "y-down" else rotated(ply, R_UP_WORLDS[up])


def _trajectory(folder: RunFolder, up: str) -> Trajectory:
    """The optimised trajectory in the given axes."""
    folder.require(ESTIMATE)
    trajectory = folder.trajectory("optimised")
    if trajectory is None:
        raise RunError(f"{folder.path} has no optimised trajectory: run the sequence again")
    frames = known(folder.metrics().sequence.frames)
    if frames is not None and frames != len(trajectory):
        raise RunError(f"{folder.path}: {ESTIMATE} is damaged: it has {len(trajectory)} rows for {frames} frames")
    if up != "y-down":
        T_up_world = se3.make(R_UP_WORLDS[up], np.zeros(3))
        trajectory = replace(trajectory, T_world_camera=T_up_world @ trajectory.T_world_camera)
    return trajectory
