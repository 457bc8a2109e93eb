"""The five-frame snippet protocol for ego-motion (Zhou et al. 2017, section 4.2).

Conventions: ``docs/design/conventions.md``. Poses of a snippet are written in the frame of its first camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]
Fidelity = Literal["default", "paper"]

# The reference code sizes its error array by images instead of snippets: length - 1 rows stay zero.
_PAPER_ZERO_ROWS = 4
# Predicted over true motion below which the prediction is rounding noise, to which no scale is fitted.
_STILL_RATIO = 1e-10


@dataclass(frozen=True)
class SnippetErrors:
    """Mean and population standard deviation over snippets.

    ``ate``: norm of the position errors of a snippet after its own scale, over its length (metres, or the
    units of the truth). ``re``: rotation error in radians, averaged over all frames of a snippet, the
    first and always perfect one included. ``count``: true number of snippets, whatever the fidelity.
    """

    ate_mean: float
    ate_std: float
    re_mean: float
    re_std: float
    count: int


def snippet_errors(
    T_first_k_pred: FloatArray, T_first_k_true: FloatArray, fidelity: Fidelity = "default"
) -> SnippetErrors:
    """Errors of predicted snippets, each after its own least-squares scale.

    s   = sum(g . p) / sum(p . p)                    over the positions of one snippet
    ATE = sqrt(sum |g - s p|^2) / K                  K frames: not a root mean square
    RE  = sum_k angle(R_true,k R_pred,k^T) / K

    A snippet that predicts no motion has no scale and is scored as standing still.

    Args:
        T_first_k_pred: predicted poses ``(S, K, 4, 4)``, any scale.
        T_first_k_true: true poses ``(S, K, 4, 4)``, at least one snippet.
        fidelity: ``paper`` adds the four zero rows that the reference code averages over.
    """
    predicted = np.asarray(T_first_k_pred, dtype=np.float64)
    truth = np.asarray(T_first_k_true, dtype=np.float64)
    count, length = predicted.shape[:2]
    p, g = predicted[..., :3, 3], truth[..., :3, 3]
    energy, true_energy = (p**2).sum(axis=(1, 2)), (g**2).sum(axis=(1, 2))
    scale = np.zeros(count)
    np.divide(
        (g * p).sum(axis=(1, 2)), energy, out=scale, where=energy > _STILL_RATIO**2 * true_energy
    )
    ate = np.sqrt(((g - scale[:, None, None] * p) ** 2).sum(axis=(1, 2))) / length
    R_error = truth[..., :3, :3] @ np.swapaxes(predicted[..., :3, :3], -1, -2)
    angles = Rotation.from_matrix(R_error.reshape(-1, 3, 3)).magnitude()
    re = angles.reshape(count, length).sum(axis=1) / length
    if fidelity == "paper":
        ate, re = np.pad(ate, (0, _PAPER_ZERO_ROWS)), np.pad(re, (0, _PAPER_ZERO_ROWS))
    return SnippetErrors(
        float(ate.mean()), float(ate.std()), float(re.mean()), float(re.std()), count
    )


def snippets_from_trajectory(T_world_camera: FloatArray, length: int = 5) -> FloatArray:
    """Every window of consecutive frames, relative to its first: ``(N - length + 1, length, 4, 4)``.

    Args:
        T_world_camera: poses ``(N, 4, 4)``; with N < length there is no snippet.
        length: frames in a snippet.
    """
    poses = np.asarray(T_world_camera, dtype=np.float64)
    starts = np.arange(max(len(poses) - length + 1, 0))
    T_world_k = poses[starts[:, None] + np.arange(length)]  # (S, length, 4, 4)
    return np.linalg.inv(T_world_k[:, :1]) @ T_world_k


def snippet_from_network(T_source_target: FloatArray) -> FloatArray:
    """Poses of a snippet in its first camera, from a pose network's output for its middle frame.

    T_first_k = T_first_target T_k_target^-1, with the target's own identity put in the middle

    Args:
        T_source_target: ``(..., N, 4, 4)``, sources in time order, N even: target camera to source camera.

    Returns:
        ``T_first_k`` ``(..., N + 1, 4, 4)``.
    """
    sources = np.asarray(T_source_target, dtype=np.float64)
    T_k_target = np.insert(sources, sources.shape[-3] // 2, np.eye(4), axis=-3)
    T_first_k: FloatArray = T_k_target[..., :1, :, :] @ np.linalg.inv(T_k_target)
    return T_first_k
