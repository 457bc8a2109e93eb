"""Localised images as a table, as JSON and as a trajectory file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slam.commands.localisation.localiser import Localisation
from slam.formats.trajectory import Trajectory, write_kitti, write_tum
from slam.results.error_columns import DASH
from slam.runtime.errors import RunError
from slam.runtime.terminal import TerminalTable


def localisation_table(found: Sequence[Localisation]) -> TerminalTable:
    """One row an image: position in the map, nearest frame of the run, inliers; below, why one is not found."""
    located = sum(each.T_world_camera is not None for each in found)
    rows = []
    for each in found:
        row = [each.image, *[DASH] * 5]
        if each.T_world_camera is not None:
            position = (f"{value:.2f}" for value in each.T_world_camera[:3, 3])
            row[1:] = [*position, str(each.nearest_frame), str(each.inliers)]
        rows.append(row)
    notes = [f"{each.image} not found: {each.reason}" for each in found if each.T_world_camera is None]
    head = ["image", "x", "y", "z", "nearest\nframe", "inliers"]
    return TerminalTable(head, rows, f"{located} of {len(found)} images found", notes)


def localisation_json(found: Sequence[Localisation]) -> list[dict[str, Any]]:
    """One object an image; unknown values are null with a reason."""
    return [_entry(each) for each in found]


def _entry(each: Localisation) -> dict[str, Any]:
    entry: dict[str, Any] = {"image": each.image, "found": each.T_world_camera is not None}
    if each.T_world_camera is None:
        absent = dict.fromkeys(("position", "T_world_camera", "nearest_frame", "inliers"))
        return entry | absent | {"reason": each.reason}
    pose = {"position": each.T_world_camera[:3, 3].tolist(), "T_world_camera": each.T_world_camera.tolist()}
    return entry | pose | {"nearest_frame": each.nearest_frame, "inliers": each.inliers}


def write_localisations(path: Path, found: Sequence[Localisation], numbers: Sequence[int] | None = None) -> None:
    """Write the poses found: as TUM, or after the number of their frame as KITTI where the name ends in ``.kitti``.

    The stamp, or number, is that of the image, by default its place in the list.

    Raises:
        RunError: no image was found.
    """
    stamps = range(len(found)) if numbers is None else numbers
    poses = {k: each.T_world_camera for k, each in zip(stamps, found, strict=True) if each.T_world_camera is not None}
    if not poses:
        raise RunError(f"none of {len(found)} images was found in the map: {path} is not written")
    write = write_kitti if path.suffix == ".kitti" else write_tum
    write(path, Trajectory(np.array(list(poses), dtype=np.float64), np.stack(list(poses.values())), numbered=True))
