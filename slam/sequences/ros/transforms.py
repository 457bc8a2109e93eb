"""Static transforms of a bag: which frame is mounted where on which."""

from __future__ import annotations

import logging
from contextlib import suppress
from typing import Any

import numpy as np

from slam.geometry.se3 import FloatArray, invert
from slam.sequences.poses import poses_of
from slam.sequences.ros.bag import Bag

logger = logging.getLogger(__name__)

TOPIC, MOVING_TOPIC = "/tf_static", "/tf"


class StaticTransforms:
    """The tree of the frames of ``/tf_static``."""

    def __init__(self, bag: Bag) -> None:
        """Read all static transforms, without bad ones; the last of a frame counts."""
        self._parents: dict[str, tuple[str, FloatArray]] = {}
        for message in bag.messages(TOPIC) if TOPIC in bag.types else ():
            for each in message.transforms:
                try:
                    mount = frame_name(each.header.frame_id), transform_of(each.transform)
                except ValueError as error:
                    logger.warning("%s: the transform of %r is left out: %s", TOPIC, each.child_frame_id, error)
                    continue
                self._parents[frame_name(each.child_frame_id)] = mount

    def between(self, a: str, b: str) -> FloatArray | None:
        """``T_a_b`` ``(4, 4)`` of two frames; None where no static transforms join them, or where one has no name."""
        if not (frame_name(a) and frame_name(b)):
            return None
        (root_a, T_root_a), (root_b, T_root_b) = (self._from_root(frame_name(frame)) for frame in (a, b))
        return invert(T_root_a) @ T_root_b if root_a == root_b else None

    def _from_root(self, frame: str) -> tuple[str, FloatArray]:
        T_root_frame, seen = np.eye(4), {frame}
        while frame in self._parents:
            frame, T_parent_child = self._parents[frame]
            if frame in seen:
                break  # a loop has no root
            seen.add(frame)
            T_root_frame = T_parent_child @ T_root_frame
        return frame, T_root_frame


def moving_frames(bag: Bag) -> dict[tuple[str, str], tuple[FloatArray, FloatArray]]:
    """Stamps ``(M,)`` and ``T_parent_child`` ``(M, 4, 4)`` of the frames of ``/tf``, by parent and child."""
    found: dict[tuple[str, str], dict[float, FloatArray]] = {}
    for message in bag.messages(MOVING_TOPIC) if MOVING_TOPIC in bag.types else ():
        for each in message.transforms:
            stamp = each.header.stamp.sec + 1e-9 * each.header.stamp.nanosec
            with suppress(ValueError):
                frames = frame_name(each.header.frame_id), frame_name(each.child_frame_id)
                found.setdefault(frames, {}).setdefault(stamp, transform_of(each.transform))
    moving = {}
    for frames, poses in found.items():
        stamps = sorted(poses)
        moving[frames] = np.array(stamps), np.stack([poses[stamp] for stamp in stamps])
    return moving


def frame_name(text: str) -> str:
    """The name of a frame; ROS 1 may write it with a slash."""
    return text.removeprefix("/")


def transform_of(message: Any) -> FloatArray:
    """``T_parent_child`` ``(4, 4)`` of a ``Transform`` or a ``Pose``.

    Raises:
        ValueError: its rotation is none, or its position is not finite.
    """
    t = message.translation if hasattr(message, "translation") else message.position
    q = message.rotation if hasattr(message, "rotation") else message.orientation
    T: FloatArray = poses_of(np.array([[t.x, t.y, t.z]]), np.array([[q.x, q.y, q.z, q.w]]))[0]
    return T
