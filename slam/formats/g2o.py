"""Pose graphs in g2o's text format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from erfsfm.common.files import read_text
from slam.frames import RelativePose
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import RunError
from slam.runtime.storage.files import write_atomically

_TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]
_UPPER = np.triu_indices(6)
_VERTEX, _EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"
_INDICES = {_VERTEX: 1, _EDGE: 2}
_UNIT_TOLERANCE = 1e-6
_NUMBERS = {_VERTEX: 7, _EDGE: 7 + 21}  # a pose, and the upper triangle of the information matrix


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


def check_g2o(path: Path) -> None:
    """Check that a file is a whole graph as written by `write_g2o`.

    Raises:
        RunError: it is missing, cut short, or a line is not one of the graph.
    """
    try:
        text = read_text(path, "ascii")
        if not text.endswith("\n"):
            raise ValueError("its last line is cut short")
        vertices = 0
        ends: list[tuple[int, int]] = []
        for number, (kind, *words) in enumerate((line.split() for line in text.splitlines()), start=1):
            indices = _INDICES.get(kind)
            if indices is None or len(words) != indices + _NUMBERS[kind]:
                raise ValueError(f"line {number} is neither a vertex nor an edge")
            numbers = np.array(words[indices:], dtype=np.float64)
            if not np.isfinite(numbers).all() or abs(np.linalg.norm(numbers[3:7]) - 1) > _UNIT_TOLERANCE:
                raise ValueError(f"line {number} has a number that is not finite, or no rotation")
            if kind == _VERTEX:
                vertices += 1
            else:
                ends.append((int(words[0]), int(words[1])))
        edges = np.array(ends, dtype=np.int64).reshape(-1, 2)
        if edges.size and not 0 <= edges.min() <= edges.max() < vertices:
            raise ValueError("an edge has a vertex that does not exist")
    except (OSError, ValueError, OverflowError) as error:
        raise RunError(f"{path} is no pose graph that can be read ({error}): run the sequence again") from error
