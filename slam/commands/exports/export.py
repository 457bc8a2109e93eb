"""Parts of a run as files for other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from erfsfm.common.progress import Progress, silent
from slam.commands.exports.colmap import write_model
from slam.commands.exports.nerfstudio import write_scene
from slam.commands.exports.occupancy import occupancy_grid
from slam.commands.exports.parts import R_UP_WORLDS, check_options, check_target
from slam.formats.ply import Ply, read_ply, rotated, write_ply
from slam.formats.ros_map import write_ros_map
from slam.formats.trajectory import Trajectory
from slam.geometry import se3
from slam.results.folder import RunFolder
from slam.results.metrics import CAMERA_HEIGHTS, METRES
from slam.runtime.errors import RunError
from slam.runtime.run_files import ESTIMATE, MAP_CLOUD, MAP_MESH

_MAPS = {"mesh": MAP_MESH, "cloud": MAP_CLOUD}
_RESOLUTION = 0.1  # of an occupancy grid


def export(
    folder: RunFolder,
    what: str,
    output: Path,
    up: str = "y-down",
    *,
    resolution: float | None = None,
    dataset: Path | None = None,
    points: int | None = None,
    progress: Progress = silent,
) -> Path:
    """Write one part of a run, each file whole or not at all; missing parent folders are made.

    The part is read whole and checked before anything is written.

    Args:
        folder: the run.
        what: ``mesh`` or ``cloud`` (PLY), ``colmap`` (a model), ``nerfstudio`` (images and ``transforms.json``) or
            ``occupancy`` (a grid for ROS, always with z up).
        output: the file; for ``colmap`` and ``nerfstudio`` the folder.
        up: ``y-down`` as the run has it; ``z``: x right, y ahead, z up. Cameras keep their own axes, only the world is
            rotated.
        resolution: side of a cell of an occupancy grid.
        dataset: where the images of the run are now, for ``colmap`` and ``nerfstudio``; None where the run found them.
        points: at most so many of a COLMAP model.
        progress: called with (stage, done, total).

    Returns:
        What was written.

    Raises:
        SlamError: an option that is unknown or has no effect, a part that the run lacks or that is damaged, images
            that are not found, or a file that cannot be written.
    """
    check_options(what, up, resolution, dataset, points)
    check_target(folder, what, output)
    if what in _MAPS:
        write_ply(output, _map(folder, what, up))
    elif what == "occupancy":
        return _export_occupancy(folder, output, resolution or _RESOLUTION)
    else:
        trajectory, cloud = _trajectory(folder, up), _cloud(folder, up)
        if what == "colmap":
            write_model(folder, output, trajectory, R_UP_WORLDS[up], cloud, dataset, points, progress)
        else:
            write_scene(folder, output, trajectory, cloud, dataset, progress)
    return output


def _export_occupancy(folder: RunFolder, output: Path, resolution: float) -> Path:
    unit = folder.metrics().unit
    if unit not in (METRES, CAMERA_HEIGHTS):
        raise RunError(f"heights above the road need metres or camera heights, but this run's lengths are in {unit}")
    mesh, trajectory = _map(folder, "mesh", "z"), _trajectory(folder, "z")
    grid = occupancy_grid(mesh, trajectory.T_world_camera, resolution, unit == METRES)
    written = output.with_suffix(".yaml")
    write_ros_map(written, grid.cells, grid.corner, grid.resolution, unit)
    return written


def _cloud(folder: RunFolder, up: str) -> Ply | None:
    """The cloud of the map, None where the run has none."""
    return _map(folder, "cloud", up) if (folder.path / MAP_CLOUD).is_file() else None


def _map(folder: RunFolder, what: str, up: str) -> Ply:
    """The mesh or cloud of the map in the given axes."""
    ply = read_ply(folder.require(_MAPS[what]))
    if len(ply.vertices) == 0 or (ply.triangles is not None and len(ply.triangles) == 0):
        raise RunError("the map is empty: there is nothing to export")
    return ply if up == "y-down" else rotated(ply, R_UP_WORLDS[up])


def _trajectory(folder: RunFolder, up: str) -> Trajectory:
    """The optimised trajectory in the given axes."""
    folder.require(ESTIMATE)
    trajectory = folder.trajectory("optimised")
    if trajectory is None:
        raise RunError(f"{folder.path} has no optimised trajectory: run the sequence again")
    frames = folder.metrics().sequence.frames
    if frames is not None and frames != len(trajectory):
        raise RunError(f"{folder.path}: {ESTIMATE} is damaged: it has {len(trajectory)} rows for {frames} frames")
    if up != "y-down":
        T_up_world = se3.make(R_UP_WORLDS[up], np.zeros(3))
        trajectory = replace(trajectory, T_world_camera=T_up_world @ trajectory.T_world_camera)
    return trajectory
