"""Rotations of single steps, corrected by relative rotations across two steps.

There the tracking error of a corner enters half as often. Directions are corrected by as much as
their covariance with the rotation says (``docs/design/visual-front-end.md``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.sparse import bsr_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from slam.frontend.visual.motion import RelativeRotation, Steps, triangulated
from slam.geometry.se3 import invert, normalised

# sigmas of single steps are widened by this: the errors of neighbouring steps are correlated
_STEP_WIDENING = 3.0
_OVERLAPPING = 2  # relative rotations that share their images, which count as one
_ITERATIONS = 4
_OUTLIER_SIGMAS = 3.0


def smooth_rotations(
    steps: Steps, relative_rotations: Mapping[tuple[int, int, int], RelativeRotation]
) -> Steps:
    """The steps with rotations fitted robustly to single steps and relative rotations, directions corrected alike.

    Least squares over one small rotation for each triangulated step, in its current camera. The
    residual of a relative rotation is the sum of the corrections of its two steps, in its last
    camera. Rotations over a step that is not triangulated are not used; by their three frames.
    """
    motions = triangulated(steps)
    place = {ends: row for row, ends in enumerate(motions)}
    usable = [f for f in relative_rotations if place.keys() >= {f[:2], f[1:]}]
    if not usable:
        return steps
    T_current_previous = invert(
        np.array([motion.relative_pose.T_from_to for motion in motions.values()])
    )
    first, second = np.array([(place[f[:2]], place[f[1:]]) for f in usable]).T
    R_first, R_second = T_current_previous[first, :3, :3], T_current_previous[second, :3, :3]
    across = [relative_rotations[frames] for frames in usable]
    noise = np.array([rotation.sigmas for rotation in across])
    # whitened equations of the relative rotations in the corrections of both steps
    blocks = np.stack([np.broadcast_to(np.eye(3), R_second.shape), R_second], axis=1)
    whitened = (blocks / noise[:, None, :, None]).reshape(-1, 3, 3)
    columns = np.column_stack([second, first]).ravel()
    shape = 3 * len(usable), 3 * len(motions)
    A = bsr_array((whitened, columns, np.arange(0, len(columns) + 1, 2)), shape).tocsr()
    R_to_from = np.array([rotation.R_to_from for rotation in across])
    off = Rotation.from_matrix(R_to_from @ np.swapaxes(R_second @ R_first, 1, 2))
    target = (off.as_rotvec() / noise).ravel()
    sigmas = np.concatenate([motion.relative_pose.sigmas[:3] for motion in motions.values()])
    own = 1.0 / (_STEP_WIDENING * sigmas) ** 2
    prior = diags_array(own)
    correction = np.zeros(len(own))
    for _ in range(_ITERATIONS):
        residual = np.linalg.norm((A @ correction - target).reshape(-1, 3), axis=1)
        weights = np.repeat(1.0 / (1.0 + (residual / _OUTLIER_SIGMAS) ** 2), 3) / _OVERLAPPING
        weighted = A.multiply(weights[:, None]).T.tocsr()
        correction = np.atleast_1d(spsolve((weighted @ A + prior).tocsc(), weighted @ target))
    turns = correction.reshape(-1, 3)
    T_current_previous[:, :3, :3] = (
        Rotation.from_rotvec(turns).as_matrix() @ T_current_previous[:, :3, :3]
    )
    covariances = np.array([motion.covariance for motion in motions.values()])
    moves = covariances[:, 3:, :3] @ np.linalg.solve(covariances[:, :3, :3], turns[:, :, None])
    directions = T_current_previous[:, :3, 3]
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    turned = directions + lengths * moves[:, :, 0]
    T_current_previous[:, :3, 3] = lengths * normalised(turned)
    smoothed = dict(steps)
    for motion, T in zip(motions.values(), invert(T_current_previous), strict=True):
        pose = replace(motion.relative_pose, T_from_to=T)
        smoothed[motion.ends] = replace(motion, relative_pose=pose)
    return smoothed
