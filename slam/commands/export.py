"""Parts of a run as files for other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from erfsfm.common.files import is_foreign
from erfsfm.common.progress import Progress, silent
from slam.commands.occupancy import occupancy_grid, write_ros_map
from slam.commands.scenes import MARK, POINTS, TRANSFORMS, write_model, write_scene
from slam.formats.colmap import BINARY_FOLDER, HEADER, MODEL_FILES
from slam.formats.ply import Ply, read_ply, rotated, write_ply
from slam.formats.trajectory import Trajectory
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.results.folder import RunFolder
from slam.results.metrics import CAMERA_HEIGHTS, METRES
from slam.results.output import check_replaced
from slam.runtime.errors import RunError
from slam.runtime.run_files import ESTIMATE, MAP_CLOUD, MAP_MESH

What = Literal["mesh", "cloud", "colmap", "nerfstudio", "occupancy"]
Up = Literal["y-down", "z"]
# from a camera's x right, y down, z ahead
R_UP_WORLDS: dict[Up, FloatArray] = {
    "y-down": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),  # x right, y ahead, z up
}
_MAPS = {"mesh": MAP_MESH, "cloud": MAP_CLOUD}
_SCENES = {
    "colmap": ("a COLMAP model", ("images", BINARY_FOLDER, *MODEL_FILES), MODEL_FILES[0], HEADER),
    "nerfstudio": ("a scene", ("images", POINTS, TRANSFORMS), TRANSFORMS, MARK),
}
_TAKERS = {"resolution": ("occupancy",), "dataset": tuple(_SCENES), "points": ("colmap",)}
_RESOLUTION = 0.1  # of an occupancy grid


def export(
    folder: RunFolder,
    what: What,
    output: Path,
    up: Up = "y-down",
    *,
    resolution: float | None = None,
    dataset: Path | None = None,
    points: int | None = None,
    progress: Progress = silent,
) -> Path:
    """Write one part of a run, each file whole or not at all; missing parent folders are made.

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
        SlamError: an option unknown or without effect, a part that the run lacks or that is damaged, missing images,
            or a file that cannot be written.
    """
    if what not in get_args(What) or up not in R_UP_WORLDS:
        raise RunError(f"what is one of {', '.join(get_args(What))}, up {' or '.join(R_UP_WORLDS)}; got {what}, {up}")
    for name, value in {"resolution": resolution, "dataset": dataset, "points": points}.items():
        if value is not None and what not in _TAKERS[name]:
            raise RunError(f"--{name} does nothing for {what}: it is for {' and '.join(_TAKERS[name])}")
    _check_target(what, output)
    if what in _MAPS:
        write_ply(output, _map(folder, what, up))
    elif what == "occupancy":
        return _export_occupancy(folder, output, resolution or _RESOLUTION)
    else:
        trajectory = _trajectory(folder, up)
        cloud = _map(folder, "cloud", up) if (folder.path / MAP_CLOUD).is_file() else None
        if what == "colmap":
            write_model(folder, output, trajectory, R_UP_WORLDS[up], cloud, dataset, points, progress)
        else:
            write_scene(folder, output, trajectory, cloud, dataset, progress)
    return output


def _check_target(what: str, output: Path) -> None:
    """Refuse, before anything is computed, what would replace a file of another kind."""
    if what in _SCENES:
        noun, names, marked, mark = _SCENES[what]
        if output.exists() and not output.is_dir():
            raise RunError(f"{output} is a file: {noun} is several files, give the name of a folder")
        others = [name for name in names if (output / name).exists()]
        if others and not _is_own(output / marked, mark):
            raise RunError(f"{output / others[0]} is none of ours and would be replaced: choose another --output")
        return
    beginnings = {".yaml": b"", ".pgm": b"P5"} if what == "occupancy" else {".ply": b"ply"}
    if output.suffix.lower() not in beginnings:
        named = " or ".join(beginnings)
        raise RunError(f"{what} is written as {named}; got '{output.name}', give a name that ends so")
    files = [output]
    if what == "occupancy":
        files = [output.with_suffix(suffix) for suffix in beginnings]
        present = [path for path in files if path.is_file() and path.stat().st_size]
        if present and not _is_own(files[0], "occupied_thresh:"):
            raise RunError(f"{present[0]} exists and is no map of ROS: choose another --output")
    for path in files:
        check_replaced(path, beginnings)


def _is_own(path: Path, mark: str) -> bool:
    return path.is_file() and not is_foreign(path, mark)


def _export_occupancy(folder: RunFolder, output: Path, resolution: float) -> Path:
    unit = folder.metrics().unit
    if unit not in (METRES, CAMERA_HEIGHTS):
        raise RunError(f"heights above the road need metres or camera heights, but this run's lengths are in {unit}")
    mesh, trajectory = _map(folder, "mesh", "z"), _trajectory(folder, "z")
    cells, grid = occupancy_grid(mesh, trajectory.T_world_camera, resolution, unit == METRES)
    written = output.with_suffix(".yaml")
    write_ros_map(written, cells, (grid.x_min, grid.y_min), resolution, unit)
    return written


def _map(folder: RunFolder, what: str, up: Up) -> Ply:
    """The mesh or cloud of the map in the given axes."""
    ply = read_ply(folder.require(_MAPS[what]))
    if len(ply.vertices) == 0 or (ply.triangles is not None and len(ply.triangles) == 0):
        raise RunError("the map is empty: there is nothing to export")
    return ply if up == "y-down" else rotated(ply, R_UP_WORLDS[up])


def _trajectory(folder: RunFolder, up: Up) -> Trajectory:
    """The optimised trajectory in the given axes."""
    folder.require(ESTIMATE)
    trajectory = folder.trajectory("optimised")
    if trajectory is None:
        raise RunError(f"{folder.path} has no optimised trajectory: run the sequence again")
    frames = folder.metrics().sequence.frames
    if frames is not None and frames != len(trajectory):
        raise RunError(f"{folder.path}: {ESTIMATE} is damaged: it has {len(trajectory)} rows for {frames} frames")
    return replace(trajectory, T_world_camera=se3.make(R_UP_WORLDS[up], np.zeros(3)) @ trajectory.T_world_camera)
