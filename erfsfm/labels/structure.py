"""What is known of depth and motion of a snippet, as labels for both networks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

HEIGHTS = 10.0  # camera heights in the networks' unit of depth: steps are then as small as initial outputs


@dataclass(frozen=True)
class TeacherStructure:
    """Lengths are in heights of the camera over the road.

    Attributes:
        T_source_target: ``(N, 4, 4)``, NaN where nothing is known.
        least: smallest inverse depth that agrees with what is known, ``(H, W)``, 0 where unbounded.
        most: largest one, infinite where unbounded.
    """

    T_source_target: NDArray[np.float32]
    least: NDArray[np.floating]
    most: NDArray[np.floating]


def snippet_motion(T_world_camera: NDArray[np.float64], first: int, sources: int) -> NDArray[np.float64]:
    """``T_source_target`` ``(N, 4, 4)`` of the snippet that begins at pose ``first`` of ``(frames, 4, 4)``."""
    target = first + sources // 2
    others = np.delete(np.arange(first, first + sources + 1), sources // 2)
    return np.asarray(np.linalg.inv(T_world_camera[others]) @ T_world_camera[target])
