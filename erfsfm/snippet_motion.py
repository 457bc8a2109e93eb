"""Motion of a snippet measured in its images, from a pose network's guess.

Corners are followed from frame to frame (Lucas and Kanade 1981), and lie on the epipolar lines of the motion (Longuet-
Higgins 1981): rotations follow by least squares, and the direction of travel, where parallax tells more than the guess.
Depth is unknown, and so is the length of the path, which stays as it was guessed. Where images show nothing to follow,
all of the guess stays.

Within a snippet a camera moves steadily: its path is made of equal steps in one direction, which turns with the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from erfsfm.common.readers.camera_file import Pinhole

Array = NDArray[np.float64]
_CELL = 16  # pixels a side; of each cell the best corner is followed
_WINDOW = 11  # pixels
_HALVINGS = 3
_SEARCH = (
    cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS,
    10,
    0.03,
)  # iterations, and pixels of the last one
_LEAST_TEXTURE = 1e-4  # smaller eigenvalue of the structure tensor, by OpenCV's measure
_SAME = 0.5  # pixels from a corner to where it is followed back to
_PIXEL_SIGMA = 0.25
_GUESS_SIGMA = np.radians(0.6)  # of the guessed direction of travel
_LARGEST_TURN = np.radians(3.0)  # sigma of a rotation in one step of the least squares
_OUTLIERS = (
    8.0,
    3.0,
    1.0,
    1.0,
)  # sigmas at which a corner counts half, for each step (Cauchy's weights)
LIKE_KITTI = Pinhole(
    1, 1, 0.58, 1.92, 0.495 - 0.5, 0.48 - 0.5
)  # of images whose camera nobody tells, once resized


class Followed(NamedTuple):
    """Corners of an image ``(P, 2)`` in pixels, where the next image has them, and which were followed ``(P,)``."""

    before: Array
    after: Array
    known: NDArray[np.bool_]


def followed(image: NDArray[np.uint8], after: NDArray[np.uint8]) -> Followed:
    """The best corner of each cell of a grey image ``(H, W)``, in the next one."""
    rows, columns = image.shape[0] // _CELL, image.shape[1] // _CELL
    strength = cv2.cornerMinEigenVal(image, 5)[: rows * _CELL, : columns * _CELL]
    cells = strength.reshape(rows, _CELL, columns, _CELL).swapaxes(1, 2).reshape(rows * columns, -1)
    best = cells.argmax(axis=1)
    row, column = np.divmod(np.arange(rows * columns), columns)
    corners = np.stack([column * _CELL + best % _CELL, row * _CELL + best // _CELL], axis=1).astype(
        np.float32
    )
    search: dict[str, Any] = {"winSize": (_WINDOW, _WINDOW), "criteria": _SEARCH}
    found, there, _ = cv2.calcOpticalFlowPyrLK(
        image, after, corners[:, None], None, maxLevel=_HALVINGS, **search
    )  # type: ignore[call-overload]
    search |= {
        "maxLevel": 0,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }  # back from where it was takes no pyramid
    returned, back, _ = cv2.calcOpticalFlowPyrLK(
        after, image, found, corners[:, None].copy(), **search
    )
    known = (
        (there[:, 0] > 0)
        & (back[:, 0] > 0)
        & (np.abs(returned[:, 0] - corners).max(axis=1) < _SAME)
    )
    known &= cells.max(axis=1) > _LEAST_TEXTURE
    return Followed(
        corners.astype(float), np.where(known[:, None], found[:, 0], corners).astype(float), known
    )


def measured(T_source_target: Array, steps: Sequence[Followed], camera: Pinhole) -> Array:
    """The motion with rotations and the direction of travel as the images have them.

    Args:
        T_source_target: the guess, ``(N, 4, 4)``.
        steps: corners of each image but the last, followed into the next one; N.
        camera: of the images.

    Returns:
        ``T_source_target`` ``(N, 4, 4)``.
    """
    middle, count = len(steps) // 2, len(steps)
    T_image_target = np.insert(T_source_target, middle, np.eye(4), axis=0)
    T_next_image = T_image_target[1:] @ np.linalg.inv(T_image_target[:-1])
    R, t = T_next_image[:, :3, :3], T_next_image[:, :3, 3]
    travel = np.linalg.solve(_halfway(R), t[..., None])[..., 0].mean(axis=0)
    length = np.linalg.norm(travel)
    R, direction = _fitted(
        steps, camera, R, travel / length if length > 0 else np.array([0.0, 0.0, -1.0])
    )
    T_next_image = np.tile(np.eye(4), (count, 1, 1))
    T_next_image[:, :3, :3], T_next_image[:, :3, 3] = R, length * _halfway(R) @ direction
    T = [np.eye(4)]
    for k in range(middle - 1, -1, -1):
        T.insert(0, np.linalg.inv(T_next_image[k]) @ T[0])
    for k in range(middle, count):
        T.append(T_next_image[k] @ T[-1])
    del T[middle]
    return np.stack(T)


def _fitted(
    steps: Sequence[Followed], camera: Pinhole, R: Array, guess: Array
) -> tuple[Array, Array]:
    """Rotations ``(N, 3, 3)`` from each image to the next, and the direction of travel ``(3,)``, by Gauss and Newton.

    The residual of a corner is its distance in pixels from the epipolar line ``t x R x`` of its ray ``x``, in the next
    image. Rotations are eliminated, each of which is in one step alone, so that three unknowns are left.
    """
    f, c = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    rays, seen = (
        np.pad((np.stack(pixels) - c) / f, ((0, 0), (0, 0), (0, 1)), constant_values=1.0)
        .swapaxes(1, 2)
        .copy()
        for pixels in ([step.before for step in steps], [step.after for step in steps])
    )
    information = np.stack([step.known for step in steps])[:, None] / _PIXEL_SIGMA**2
    along, direction = np.outer(guess, guess), guess
    prior = (np.eye(3) - along) / _GUESS_SIGMA**2 + 1e8 * along  # the length is not measured
    for outlier in _OUTLIERS:
        M = _halfway(R)
        t, turned = (M @ direction)[..., None], R @ rays
        slope = np.cross(t, turned, axis=1)[:, :2]  # of the epipolar line
        width = np.maximum(np.sqrt(((slope / f[:, None]) ** 2).sum(axis=1, keepdims=True)), 1e-12)
        normal = np.cross(turned, seen, axis=1)
        by_turn = seen * (turned * t).sum(axis=1, keepdims=True) - t * (turned * seen).sum(
            axis=1, keepdims=True
        )
        J = np.concatenate([by_turn, normal], axis=1) / width  # (N, 6, P)
        error = (J[:, 3:] * t).sum(axis=1, keepdims=True)
        weighted = J * (information / (1 + information * (error / outlier) ** 2))
        A, b = weighted @ J.swapaxes(1, 2), -(weighted * error).sum(axis=2)
        A[:, :3, :3] += np.eye(3) / _LARGEST_TURN**2
        of_travel, turn = np.split(
            np.linalg.solve(A[:, :3, :3], np.dstack([A[:, :3, 3:], b[:, :3]])), [3], axis=-1
        )
        left = A[:, 3:, 3:] - A[:, 3:, :3] @ of_travel
        right = b[:, 3:] - (A[:, 3:, :3] @ turn)[..., 0]
        system = (M.swapaxes(1, 2) @ left @ M).sum(axis=0) + prior
        shift = np.linalg.solve(
            system, _turned(M.swapaxes(1, 2), right).sum(axis=0) + prior @ (guess - direction)
        )
        R = Rotation.from_rotvec(turn[..., 0] - _turned(of_travel, M @ shift)).as_matrix() @ R
        direction = (direction + shift) / np.linalg.norm(direction + shift)
    return R, direction


def _halfway(R: Array) -> Array:
    """A step's translation from that in the camera halfway, whose axes are the means of those of both cameras."""
    return (np.eye(3) + R) / 2


def _turned(R: Array, vectors: Array) -> Array:
    """Matrices ``(N, M, 3)`` times vectors ``(N, 3)``."""
    return (R @ vectors[..., None])[..., 0]
