"""A run as a COLMAP scene: undistorted images, poses, corners tracked through them, and the cloud of the map."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from erfsfm.common.progress import Progress
from slam.commands.exports.images import interpolated, is_recorded, write_images
from slam.formats.colmap import Sightings, write_colmap
from slam.formats.ply import Ply
from slam.formats.trajectory import Trajectory
from slam.geometry.se3 import FloatArray
from slam.loops.places import Places
from slam.loops.structure import PlaceStructure
from slam.loops.verification import OF_KEYFRAMES
from slam.results.folder import RunFolder
from slam.runtime.run_files import PLACES

logger = logging.getLogger(__name__)

_GREY = 128


def write_model(
    folder: RunFolder,
    output: Path,
    trajectory: Trajectory,
    R_up_world: FloatArray,
    cloud: Ply | None,
    dataset: Path | None,
    at_most: int | None,
    progress: Progress,
) -> None:
    """Write ``images/`` and, last, the model.

    Args:
        folder: the run; one that does not record where its images are has none here, with a warning.
        output: made where missing.
        trajectory: optimised, in the axes of the model.
        R_up_world: ``(3, 3)`` from the axes of the run to these.
        cloud: of the map, in these axes.
        dataset: where the images are now; None where the run found them.
        at_most: so many points; None for all.
        progress: called with (stage, done, total).

    Raises:
        SlamError: the images are not there or are others, or a file cannot be written.
    """
    places = Places.read(folder.require(PLACES))
    without = interpolated(folder)
    if dataset is None and not is_recorded(folder):
        logger.warning("%s does not record where its images are: the model has none; give --dataset", folder.path)
    else:
        _, written = write_images(folder, output, trajectory, dataset, progress)
        without = set(range(len(trajectory))) - set(written)
    points, sightings = _tracked(places, at_most)
    points = points @ R_up_world.T
    colours = np.full((len(points), 3), _GREY, np.uint8)
    if cloud is not None:
        if len(points):
            colours = cloud.colours_or_grey[cKDTree(cloud.points).query(points)[1]]
        rows = np.arange(len(cloud.points))
        if at_most is not None:
            left = max(at_most - len(points), 0)
            rows = np.linspace(0, len(rows) - 1, min(left, len(rows))).round().astype(np.intp)
        points = np.concatenate([points, cloud.points[rows]])
        colours = np.concatenate([colours, cloud.colours_or_grey[rows]])
    write_colmap(output, places.intrinsics, trajectory.T_world_camera, points, colours, sightings, without)


def _tracked(places: Places, at_most: int | None) -> tuple[FloatArray, Sightings]:
    """Points of corners ``(P, 3)`` in the axes of the run, at most as many as wanted, the longest tracks first."""
    if not places.views:
        return np.zeros((0, 3)), Sightings.none()
    structure = PlaceStructure(places, OF_KEYFRAMES)
    tracks = structure.tracks()
    length = np.bincount(tracks.point, minlength=len(tracks.points))
    wanted = np.isfinite(tracks.points).all(axis=1)
    chosen = np.argsort(np.where(wanted, -length, 1), kind="stable")[: int(wanted.sum())][:at_most]
    number = np.full(len(tracks.points), -1)
    number[chosen] = np.arange(len(chosen))
    kept = number[tracks.point] >= 0
    views, corners = tracks.views[kept], tracks.corners[kept]
    pixels = structure.pixels(views, corners)
    frames = np.array([view.index for view in places.views], np.intp)[views]
    return tracks.points[chosen], Sightings(frames, pixels, number[tracks.point[kept]], tracks.errors_px[kept])
