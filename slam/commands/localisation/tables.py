"""Localised images as a table, as JSON and as a TUM file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from slam.commands.localisation.accuracy import PoseError, summary
from slam.commands.localisation.localiser import Localisation
from slam.formats.trajectory import Trajectory, write_tum
from slam.results.error_columns import DASH
from slam.runtime.errors import RunError
from slam.runtime.terminal import TerminalTable


def localisation_table(
    found: Sequence[Localisation], errors: Sequence[PoseError | None] | None = None
) -> TerminalTable:
    """One row an image: position in the map, nearest frame of the run, inliers, errors; below, why one is not found."""
    located = sum(each.T_world_camera is not None for each in found)
    of_error = () if errors is None else ("error\nm", "error\ndeg")
    rows = []
    for each, error in zip(found, errors or [None] * len(found), strict=True):
        row = [each.image, *[DASH] * (5 + len(of_error))]
        if each.T_world_camera is not None:
            position = (f"{value:.2f}" for value in each.T_world_camera[:3, 3])
            row[1:6] = [*position, str(each.nearest_frame), str(each.inliers)]
        if error is not None:
            row[6:] = [f"{error.error_m:.3f}", f"{error.error_deg:.3f}"]
        rows.append(row)
    notes = [f"{each.image} not found: {each.reason}" for each in found if each.T_world_camera is None]
    head = ["image", "x", "y", "z", "nearest\nframe", "inliers", *of_error]
    return TerminalTable(head, rows, f"{located} of {len(found)} images found", notes)


def localisation_json(
    found: Sequence[Localisation], errors: Sequence[PoseError | None] | None = None
) -> list[dict[str, Any]] | dict[str, Any]:
    """One object an image; unknown values are null with a reason. With errors, a summary and these objects."""
    entries = [_entry(each) for each in found]
    if errors is None:
        return entries
    unknown = {field.name: None for field in fields(PoseError)}
    for entry, error in zip(entries, errors, strict=True):
        entry |= {**(unknown if error is None else asdict(error)), "success": error is not None and error.success}
    return {"summary": summary(errors), "images": entries}


def _entry(each: Localisation) -> dict[str, Any]:
    entry: dict[str, Any] = {"image": each.image, "found": each.T_world_camera is not None}
    if each.T_world_camera is None:
        absent = dict.fromkeys(("position", "T_world_camera", "nearest_frame", "inliers"))
        return entry | absent | {"reason": each.reason}
    pose = {"position": each.T_world_camera[:3, 3].tolist(), "T_world_camera": each.T_world_camera.tolist()}
    return entry | pose | {"nearest_frame": each.nearest_frame, "inliers": each.inliers}


def write_localisations(path: Path, found: Sequence[Localisation], numbers: Sequence[int] | None = None) -> None:
    """Write the poses found as a TUM file; the stamp is the number of the image, by default its place in the list.

    Raises:
        RunError: no image was found.
    """
    stamps = range(len(found)) if numbers is None else numbers
    poses = {k: each.T_world_camera for k, each in zip(stamps, found, strict=True) if each.T_world_camera is not None}
    if not poses:
        raise RunError(f"none of {len(found)} images was found in the map: {path} is not written")
    write_tum(path, Trajectory(np.array(list(poses), dtype=np.float64), np.stack(list(poses.values()))))
