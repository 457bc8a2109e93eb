"""Localised images as a table, as JSON and as a TUM file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slam.errors import RunError
from slam.localisation.localiser import Localisation
from slam.trajectory import Trajectory, write_tum

if TYPE_CHECKING:
    from rich.table import Table


def localisation_table(found: Sequence[Localisation]) -> Table:
    """One row an image: position in the map, nearest frame of the run, inliers, or why not found."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    located = sum(each.T_world_camera is not None for each in found)
    title = Text(f"{located} of {len(found)} images found")
    table = Table(title=title, title_justify="left", pad_edge=False, box=SIMPLE_HEAD)
    table.add_column("image", overflow="fold")
    for name in ("x", "y", "z", "nearest frame", "inliers"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("", overflow="fold")
    for each in found:
        if each.T_world_camera is None:
            table.add_row(Text(each.image), "", "", "", "", "", Text(f"not found: {each.reason}"))
        else:
            position = [f"{value:.2f}" for value in each.T_world_camera[:3, 3]]
            table.add_row(Text(each.image), *position, str(each.nearest_frame), str(each.inliers), "")
    return table


def localisation_json(found: Sequence[Localisation]) -> list[dict[str, Any]]:
    """One object an image; unknown values are null with a reason."""
    entries: list[dict[str, Any]] = []
    for each in found:
        entry: dict[str, Any] = {"image": each.image, "found": each.T_world_camera is not None}
        if each.T_world_camera is None:
            absent = dict.fromkeys(("position", "T_world_camera", "nearest_frame", "inliers"))
            entries.append(entry | absent | {"reason": each.reason})
        else:
            pose = {"position": each.T_world_camera[:3, 3].tolist(), "T_world_camera": each.T_world_camera.tolist()}
            entries.append(entry | pose | {"nearest_frame": each.nearest_frame, "inliers": each.inliers})
    return entries


def write_localisations(path: Path, found: Sequence[Localisation]) -> None:
    """Write the poses found as a TUM file; the stamp is the number of the image in the list, from 0.

    Raises:
        RunError: no image was found.
    """
    poses = {k: each.T_world_camera for k, each in enumerate(found) if each.T_world_camera is not None}
    if not poses:
        raise RunError(f"none of {len(found)} images was found in the map: {path} is not written")
    write_tum(path, Trajectory(np.array(list(poses), dtype=np.float64), np.stack(list(poses.values()))))
