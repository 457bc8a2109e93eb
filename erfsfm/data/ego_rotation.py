"""Rotation between neighbouring frames from tracked corners: a teacher for the pose network that needs no label.

Five-point essential matrix (Nister 2004) on Lucas-Kanade tracks. Its rotation is far better than what a young
pose network gropes for, and without the rotation of a corner no depth can be learned there.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

CORNERS = 400
LEAST_TRACKS = 40
STILL_PX = 0.2
INLIER_PX = 0.5


def relative_rotation(
    first: NDArray[np.uint8], second: NDArray[np.uint8], K: NDArray[np.float32]
) -> NDArray[np.float64] | None:
    """``R_first_second`` ``(3, 3)`` of two images ``(H, W, 3)`` of one camera; None where too little is tracked."""
    before, after = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (first, second))
    corners = cv2.goodFeaturesToTrack(before, CORNERS, 0.005, 7)
    if corners is None or len(corners) < LEAST_TRACKS:
        return None
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None, winSize=(13, 13), maxLevel=3)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(after, before, moved, None, winSize=(13, 13), maxLevel=3)
    kept = (found & found_back).ravel().astype(bool) & (np.abs(back - corners).max(axis=(1, 2)) < 0.5)
    if kept.sum() < LEAST_TRACKS:
        return None
    a, b = corners[kept, 0].astype(np.float64), moved[kept, 0].astype(np.float64)
    if np.median(np.linalg.norm(b - a, axis=1)) < STILL_PX:
        return np.eye(3)
    cv2.setRNGSeed(0)
    matrix = K.astype(np.float64)
    E, mask = cv2.findEssentialMat(a, b, matrix, method=cv2.USAC_MAGSAC, prob=0.999, threshold=INLIER_PX)
    if E is None or E.shape != (3, 3):
        return None
    inliers, R_second_first, _, _ = cv2.recoverPose(E, a, b, matrix, mask=mask)
    return R_second_first.T if inliers >= LEAST_TRACKS // 2 else None


def source_rotations(steps: Sequence[NDArray[np.float64] | None], mirrored: bool) -> NDArray[np.float32]:
    """Rotations of a snippet's sources from those of its steps.

    Args:
        steps: ``R_k_next`` of N consecutive steps, None where unknown.
        mirrored: whether the images were flipped left to right since.

    Returns:
        ``R_source_target`` ``(N, 3, 3)``, NaN where a step on the way is unknown.
    """
    count, middle = len(steps), len(steps) // 2
    unknown = np.full((3, 3), np.nan)
    rotations = []
    for source in [k for k in range(count + 1) if k != middle]:
        between = steps[source:middle] if source < middle else steps[middle:source]
        R = np.eye(3)
        for R_step in between:
            R = R @ (unknown if R_step is None else R_step)
        rotations.append(R if source < middle else R.T)
    stacked = np.stack(rotations)
    if mirrored:
        mirror = np.diag([-1.0, 1.0, 1.0])
        stacked = mirror @ stacked @ mirror
    return stacked.astype(np.float32)
