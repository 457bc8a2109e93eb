"""Rotations of single steps, corrected by relative rotations across several steps.

There the tracking error of a corner enters half as often. Directions are corrected by as much as
their covariance with the rotation says (``docs/design/visual-front-end.md``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import bsr_array, csr_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from slam.frames import Ends
from slam.frontend.visual.motion import (
    RelativeRotation,
    Steps,
    path_between,
    shortest_by_start,
    triangulated,
)
from slam.geometry.se3 import FloatArray, invert, normalised

# sigmas of single steps are widened by this: the errors of neighbouring steps are correlated
_STEP_WIDENING = 3.0
_ITERATIONS = 4
_OUTLIER_SIGMAS = 3.0


def smooth_rotations(steps: Steps, relative_rotations: Mapping[Ends, RelativeRotation]) -> Steps:
    """The steps with rotations fitted robustly to single steps and relative rotations, directions corrected alike.

    Least squares over one small rotation for each triangulated step, in its current camera. The
    residual of a relative rotation is the sum of the corrections of its steps, each in its last
    camera. Rotations over a step that is not triangulated are not used.
    """
    motions = triangulated(steps)
    by_start = shortest_by_start(motions)
    usable = []
    for ends, rotation in relative_rotations.items():
        path = path_between(by_start, *ends)
        if path:
            usable.append((rotation, path))
    if not usable:
        return steps
    T_current_previous = invert(
        np.array([motion.relative_pose.T_from_to for motion in motions.values()])
    )
    R_current_previous = dict(zip(motions, T_current_previous[:, :3, :3], strict=True))
    A, target = _equations(R_current_previous, usable)
    # relative rotations that overlap share their images: overlapping ones count as one
    overlapping = max(len(path) for _, path in usable)
    sigmas = np.concatenate([motion.relative_pose.sigmas[:3] for motion in motions.values()])
    own = 1.0 / (_STEP_WIDENING * sigmas) ** 2
    prior = diags_array(own)
    correction = np.zeros(len(own))
    for _ in range(_ITERATIONS):
        residual = np.linalg.norm((A @ correction - target).reshape(-1, 3), axis=1)
        weights = np.repeat(1.0 / (1.0 + (residual / _OUTLIER_SIGMAS) ** 2), 3) / overlapping
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


def _equations(
    R_current_previous: Mapping[Ends, FloatArray],
    usable: Sequence[tuple[RelativeRotation, list[Ends]]],
) -> tuple[csr_array, FloatArray]:
    """Whitened equations of all relative rotations in the corrections of steps: matrix and right side."""
    place = {ends: n for n, ends in enumerate(R_current_previous)}
    blocks, columns, begins, R_residual = [], [], [0], []
    for rotation, path in usable:
        R_last_step = np.eye(3)
        for ends in reversed(path):
            columns.append(place[ends])
            blocks.append(R_last_step / rotation.sigmas[:, None])
            R_last_step = R_last_step @ R_current_previous[ends]
        begins.append(len(columns))
        R_residual.append(rotation.R_to_from @ R_last_step.T)
    sigmas = np.array([rotation.sigmas for rotation, _ in usable])
    target = Rotation.from_matrix(np.array(R_residual)).as_rotvec() / sigmas
    shape = 3 * len(usable), 3 * len(place)
    return bsr_array((np.array(blocks), columns, begins), shape=shape).tocsr(), target.ravel()
