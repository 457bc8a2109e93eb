"""The messages of a live drive, one for every frame: JSON on a stream and over ZeroMQ."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from slam.formats.trajectory import Trajectory
from slam.pipeline.live_poses import LivePose
from slam.runtime.errors import SlamError
from slam.runtime.imports import import_extra

_LAST_PORT = 65535

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


@contextmanager
def emitters(stream: TextIO, address: str | None) -> Iterator[Emit]:
    """Write every message as a line, and publish it where an address is given.

    Raises:
        SlamError: pyzmq is not installed, or the address cannot be bound.
    """
    if address is None:
        yield lambda message: _write(stream, message)
        return
    (zmq,) = import_extra("live")
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        socket.linger = 1000
        place = Path(address.removeprefix("ipc://"))
        if address.startswith("ipc://") and place.exists() and not place.is_socket():  # ZeroMQ would replace it
            raise SlamError(f"--publish {address} cannot be bound: {place} is there: name a new one")
        try:
            socket.bind(address)
        except zmq.ZMQError as error:
            raise SlamError(f"--publish {address} cannot be bound: {error}; write tcp://127.0.0.1:5555") from error
        port = re.fullmatch(r"tcp://.*:(\d+)", address)
        if port and int(port[1]) > _LAST_PORT:  # ZeroMQ binds the remainder
            raise SlamError(
                f"--publish {address} cannot be bound: ports end at {_LAST_PORT}; write tcp://127.0.0.1:5555"
            )

        def both(message: dict[str, Any]) -> None:
            _write(stream, message)
            socket.send_json(message)

        yield both


def _write(stream: TextIO, message: dict[str, Any]) -> None:
    stream.write(json.dumps(message) + "\n")
    stream.flush()
