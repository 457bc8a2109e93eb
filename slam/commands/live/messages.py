"""The messages of a live drive, one for every frame, as lines of JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, TextIO

from slam.formats.trajectory import Trajectory
from slam.pipeline.live_poses import LivePose

Emit = Callable[[dict[str, Any]], None]


def pose_message(index: int, stamp: float, newest: LivePose, unit: str | None) -> dict[str, Any]:
    """One frame: its pose ``(4, 4)`` as 12 numbers, row by row as in KITTI's files."""
    pose = [float(x) for x in newest.T_world_camera[:3].ravel()]
    support = None if newest.support is None else round(newest.support, 2)
    known = {"unit": unit, "scale": newest.unit, "support": support}
    return {"type": "pose", "frame": index, "stamp": stamp, "state": newest.state, **known, "T_world_camera": pose}


def corrected_message(trajectory: Trajectory, loops: int, unit: str | None, run: str) -> dict[str, Any]:
    """All poses after the whole drive was solved, with its loops closed."""
    poses = [[float(x) for x in T[:3].ravel()] for T in trajectory.T_world_camera]
    state = "loop closed" if loops else "whole drive"
    stamps = [float(stamp) for stamp in trajectory.stamps]
    content = {"type": "trajectory", "state": state, "loops": loops, "unit": unit, "run": run}
    return content | {"stamps": stamps, "T_world_camera": poses}


def write_line(stream: TextIO, message: dict[str, Any]) -> None:
    """Write a message as a line of JSON."""
    stream.write(json.dumps(message) + "\n")
    stream.flush()
