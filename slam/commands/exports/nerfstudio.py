"""A scene for NeRF and Gaussian splatting: undistorted images, their poses, the cloud of the map."""

from __future__ import annotations

from pathlib import Path

from erfsfm.common.progress import Progress
from slam.commands.exports.images import image_name, write_images
from slam.formats.ply import Ply, write_ply
from slam.formats.trajectory import Trajectory
from slam.formats.transforms import TRANSFORMS, write_transforms
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError
from slam.runtime.storage.files import remove

POINTS = "points.ply"


def write_scene(
    folder: RunFolder,
    output: Path,
    trajectory: Trajectory,
    cloud: Ply | None,
    dataset: Path | None,
    progress: Progress,
) -> None:
    """Write ``images/``, ``points.ply`` and, last, ``transforms.json``.

    Frames without a usable image are left out.

    Args:
        folder: the run.
        output: made where missing; images and points of a scene before go, files of other names stay.
        trajectory: optimised, in the axes of the scene.
        cloud: of the map, in the same axes.
        dataset: where the images are now; None where the run found them.
        progress: called with (stage, done, total).

    Raises:
        SlamError: the images are not there or are others, or a file cannot be written.
    """
    camera, written = write_images(folder, output, trajectory, dataset, progress)
    poses = {image_name(k): trajectory.T_world_camera[k] for k in written}
    if cloud is None:
        remove(output / POINTS, RunError)
    else:
        write_ply(output / POINTS, cloud)
    write_transforms(output / TRANSFORMS, camera, poses, None if cloud is None else POINTS)
