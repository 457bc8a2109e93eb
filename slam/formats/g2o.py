"""Pose graphs in g2o's text format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from slam.frames import RelativePose
from slam.geometry.se3 import FloatArray
from slam.runtime.files import write_atomically

_TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]
_UPPER = np.triu_indices(6)  # row by row
_VERTEX, _EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"


def write_g2o(path: Path, relative_poses: Sequence[RelativePose], T_world_camera: FloatArray) -> None:
    """Write factors and poses ``(N, 4, 4)`` at full precision, atomically."""
    T_from_to = np.array([edge.T_from_to for edge in relative_poses]).reshape(-1, 4, 4)
    lines = [f"{_VERTEX} {k} {_numbers(pose)}" for k, pose in enumerate(_g2o_poses(T_world_camera))]
    for edge, pose in zip(relative_poses, _g2o_poses(T_from_to), strict=True):
        information = np.diag(1.0 / edge.graph_sigmas[_TRANSLATION_FIRST] ** 2)[_UPPER]
        lines.append(f"{_EDGE} {edge.from_index} {edge.to_index} {_numbers(pose)} {_numbers(information)}")
    write_atomically(path, "\n".join([*lines, ""]))


def _g2o_poses(T_a_b: FloatArray) -> FloatArray:
    """Translation and quaternion (xyzw) ``(N, 7)`` of poses ``(N, 4, 4)``."""
    quaternions_xyzw = Rotation.from_matrix(T_a_b[:, :3, :3]).as_quat(canonical=True)
    return np.concatenate([T_a_b[:, :3, 3], quaternions_xyzw], axis=1)


def _numbers(row: FloatArray) -> str:
    """With the shortest digits of an exact round trip."""
    return " ".join(map(repr, row.tolist()))
