"""Pose graphs in g2o's text format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from slam.frames import RelativePose
from slam.geometry.se3 import FloatArray
from slam.runtime.storage.files import write_atomically

_TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]
_UPPER = np.triu_indices(6)
_VERTEX, _EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"


def write_g2o(path: Path, relative_poses: Sequence[RelativePose], T_world_camera: FloatArray) -> None:
    """Write factors and poses ``(N, 4, 4)`` at full precision, atomically.

    Raises:
        SlamError: the file cannot be written.
    """
    T_from_to = np.array([edge.T_from_to for edge in relative_poses]).reshape(-1, 4, 4)
    lines = [f"{_VERTEX} {k} {pose}" for k, pose in enumerate(_g2o_poses(T_world_camera))]
    lines += [
        f"{_EDGE} {edge.from_index} {edge.to_index} {pose} {_g2o_information(edge.graph_sigmas)}"
        for edge, pose in zip(relative_poses, _g2o_poses(T_from_to), strict=True)
    ]
    text = "\n".join(lines) + "\n"
    write_atomically(path, lambda file: file.write_text(text, encoding="ascii"))


def _g2o_poses(T_a_b: FloatArray) -> list[str]:
    """Translation and quaternion (xyzw) of poses ``(N, 4, 4)``, shortest digits of an exact round trip."""
    if len(T_a_b) == 0:
        return []
    quaternions_xyzw = Rotation.from_matrix(T_a_b[:, :3, :3]).as_quat(canonical=True)
    rows = np.concatenate([T_a_b[:, :3, 3], quaternions_xyzw], axis=1)
    return [_numbers(row) for row in rows]


def _g2o_information(sigmas: FloatArray) -> str:
    """Upper triangle row by row; g2o puts translation first."""
    information = np.diag(1.0 / sigmas[_TRANSLATION_FIRST] ** 2)
    return _numbers(information[_UPPER])


def _numbers(row: FloatArray) -> str:
    return " ".join(map(repr, row.tolist()))
