"""Sequences of KITTI odometry, out of the archives that hold all of them."""

from __future__ import annotations

import re
from pathlib import Path

from erfsfm.common.progress import Progress
from slam.commands.downloads.connection import require_space
from slam.commands.downloads.zip_members import ZipMembers
from slam.runtime.errors import DownloadError

LICENCE = """KITTI odometry: A. Geiger, P. Lenz, C. Stiller, R. Urtasun; Karlsruhe Institute of Technology and Toyota
Technological Institute at Chicago. Licence: Creative Commons Attribution-NonCommercial-ShareAlike 3.0
(https://creativecommons.org/licenses/by-nc-sa/3.0/): name the authors, not for commercial purposes, share what
you derive under the same licence. Terms: https://www.cvlibs.net/datasets/kitti/
Cite: A. Geiger, P. Lenz, R. Urtasun: Are we ready for Autonomous Driving? CVPR 2012."""
SERVER = "https://s3.eu-central-1.amazonaws.com/avg-kitti"
_WITH_POSES = 11  # sequences 00 to 10
_SEQUENCES = 22
_COLOUR, _GREY = ("data_odometry_color.zip", "image_2"), ("data_odometry_gray.zip", "image_0")
_CALIBRATION, _POSES, _SCANS = "data_odometry_calib.zip", "data_odometry_poses.zip", "data_odometry_velodyne.zip"
_NAME = re.compile(r"\d\d")


def download_kitti(
    sequence: str, folder: Path, server: str, is_grey: bool, with_scans: bool, progress: Progress
) -> int:
    """Fetch one sequence as an odometry root: images of the left camera, calibration, times and poses.

    Files that are there already are kept, so an interrupted download goes on.

    Args:
        sequence: ``00`` to ``21``; poses are public of the first eleven.
        folder: gets ``dataset/sequences/NN`` and ``dataset/poses/NN.txt``.
        server: address of the folder of the archives.
        is_grey: the grey camera instead of the colour camera.
        with_scans: LiDAR as well.
        progress: called with (stage, done, total).

    Returns:
        The number of files.

    Raises:
        DownloadError: one line; files that are whole stay.
    """
    if not _NAME.fullmatch(sequence) or int(sequence) >= _SEQUENCES:
        raise DownloadError(f"KITTI odometry has no sequence {sequence}: give 00 to {_SEQUENCES - 1}")
    archive, camera = _GREY if is_grey else _COLOUR
    home = f"dataset/sequences/{sequence}"
    wanted: list[tuple[str, tuple[str, ...]]] = [(_CALIBRATION, (f"{home}/calib.txt", f"{home}/times.txt"))]
    if int(sequence) < _WITH_POSES:
        wanted.append((_POSES, (f"dataset/poses/{sequence}.txt",)))
    wanted.append((archive, (f"{home}/{camera}/",)))
    if with_scans:
        wanted.append((_SCANS, (f"{home}/velodyne/",)))
    parts = []
    for name, prefixes in wanted:
        source = ZipMembers(f"{server.rstrip('/')}/{name}")
        parts.append((source, source.matching(*prefixes)))
    folder.mkdir(parents=True, exist_ok=True)
    missing = (m for _, members in parts for m in members if not (folder / m.filename).is_file())
    require_space(folder, sum(member.file_size for member in missing))
    total, done = sum(len(members) for _, members in parts), 0
    for source, members in parts:
        for member in members:
            source.fetch(member, folder)
            done += 1
            progress("files", done, total)
    return total
