"""Parts of a run as files for other programs: PLY, KITTI or TUM, g2o, COLMAP."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from slam import se3
from slam.errors import RunError
from slam.formats.colmap import write_colmap
from slam.formats.g2o import check_g2o
from slam.formats.ply import read_ply, read_ply_points, rotated, write_ply
from slam.loops.places import PLACES, Places
from slam.results.comparison import lookup
from slam.results.folder import RunFolder
from slam.se3 import FloatArray
from slam.storage.files import write_atomically
from slam.trajectory import Trajectory, write_kitti, write_tum

WHATS = ("mesh", "cloud", "trajectory", "graph", "colmap")
UPS = ("y-down", "z")
# x right, y ahead, z up, from a camera's x right, y down, z ahead
R_UP_WORLD: FloatArray = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def export(folder: RunFolder, what: str, output: Path, up: str) -> Path:
    """Write one part of a run, each file whole or not at all; missing parent folders are made.

    The part is read whole and checked before anything is written.

    Args:
        folder: the run.
        what: ``mesh`` or ``cloud`` (PLY), ``trajectory`` (the optimised one: TUM where ``output`` ends in
            ``.tum`` or ``.tum.txt``, else KITTI), ``graph`` (g2o) or ``colmap`` (a model in text form).
        output: the file; for ``colmap`` the folder.
        up: ``y-down`` as the run has it, or ``z``: x right, y ahead, z up. A trajectory's cameras keep
            their own axes, only the world is rotated.

    Returns:
        What was written.

    Raises:
        RunError, TrajectoryError: an unknown ``what`` or ``up``, a part that the run lacks or that is damaged, or a
            file that cannot be written.
    """
    if what not in WHATS:
        raise RunError(f"--what {what!r} is unknown: choose one of {', '.join(WHATS)}")
    if up not in UPS:
        raise RunError(f"--up {up!r} is unknown: choose {' or '.join(UPS)}")
    if what == "colmap":
        _export_colmap(folder, output, up)
        return output
    if output.is_dir():
        raise RunError(f"{output} is a folder: give the name of a file to write")
    if what in ("mesh", "cloud"):
        _export_ply(folder.require(f"map_{what}.ply"), output, up)
    elif what == "trajectory":
        _export_trajectory(folder, output, up)
    else:
        if up != "y-down":
            raise RunError("a graph is exported as the run has it: leave --up out or give --up y-down")
        source = folder.require("graph.g2o")
        check_g2o(source)
        write_atomically(output, lambda path: shutil.copyfile(source, path), RunError)
    return output


def _export_ply(source: Path, output: Path, up: str) -> None:
    if output.suffix.lower() != ".ply":
        raise RunError(f"meshes and clouds are written as PLY; got '{output.name}', give a name that ends in .ply")
    ply = read_ply(source)
    if up == "y-down":
        write_atomically(output, lambda path: shutil.copyfile(source, path), RunError)
    else:
        write_ply(output, rotated(ply, R_UP_WORLD))


def _export_trajectory(folder: RunFolder, output: Path, up: str) -> None:
    trajectory = _trajectory(folder, up)
    write = write_tum if output.name.endswith((".tum", ".tum.txt")) else write_kitti
    write(output, trajectory)


def _export_colmap(folder: RunFolder, output: Path, up: str) -> None:
    """Poses of all frames, the run's camera, and the cloud of the map where there is one."""
    if output.is_file():
        raise RunError(f"{output} is a file: a COLMAP model is three files, give the name of a folder")
    trajectory, camera = _trajectory(folder, up), Places.read(folder.require(PLACES)).intrinsics
    cloud = folder.path / "map_cloud.ply"
    points, colours = read_ply_points(cloud) if cloud.is_file() else (np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    if up == "z":
        points = points @ R_UP_WORLD.T
    write_colmap(output, camera, trajectory.T_world_camera, points, colours)


def _trajectory(folder: RunFolder, up: str) -> Trajectory:
    """The optimised trajectory in the given axes."""
    folder.require("trajectory_optimised.tum.txt")
    trajectory = folder.trajectory("optimised")
    if trajectory is None:
        raise RunError(f"{folder.path} has no optimised trajectory: run the sequence again")
    frames, _ = lookup(folder.metrics(), "sequence", "frames")
    if frames is not None and frames != len(trajectory):
        raise RunError(
            f"{folder.path}: trajectory_optimised.tum.txt is damaged: it has {len(trajectory)} rows for {frames} frames"
        )
    if up == "z":
        T_up_world = se3.make(R_UP_WORLD, np.zeros(3))
        trajectory = Trajectory(trajectory.stamps, T_up_world @ trajectory.T_world_camera, trajectory.timed)
    return trajectory
