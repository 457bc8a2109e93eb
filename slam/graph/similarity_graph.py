"""The pose graph of maps without a common unit: poses and units of cameras that agree best with measured similarities.

As in Strasdat et al. 2010: scale drifts along a monocular map, and loops measure how far. GTSAM writes a similarity
as ``p -> s (R p + t)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from slam.geometry.se3 import FloatArray, make
from slam.graph.pose_graph import robust_noise
from slam.runtime.errors import SlamError

_ANCHOR_SIGMA = 1e-6
_MOST_ITERATIONS = 100


@dataclass(frozen=True)
class RelativeSimilarity:
    """A measured similarity between two cameras whose units of length differ: ``p_from = scale R p_to + t``.

    ``T_from_to`` ``(4, 4)`` is in the unit of the first camera, as are the ``sigmas`` ``(7,)`` of rotation and
    translation; the last sigma is that of the logarithm of the scale.
    """

    from_index: int
    to_index: int
    T_from_to: FloatArray
    scale: float
    sigmas: FloatArray


def optimise_similarities(
    T_world_camera: FloatArray, scales: FloatArray, edges: Sequence[RelativeSimilarity]
) -> tuple[FloatArray, FloatArray]:
    """Poses and units of cameras, the first one fixed.

    Args:
        T_world_camera: start ``(K, 4, 4)``.
        scales: start ``(K,)``: units of the world per unit of each camera.
        edges: connect all cameras.

    Returns:
        ``T_world_camera`` ``(K, 4, 4)`` and scales ``(K,)``.

    Raises:
        SlamError: the system cannot be solved.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, (T, scale) in enumerate(zip(T_world_camera, scales, strict=True)):
        values.insert(k, _similarity(T, float(scale)))
    fixed = gtsam.noiseModel.Isotropic.Sigma(7, _ANCHOR_SIGMA)
    graph.add(gtsam.PriorFactorSimilarity3(0, values.atSimilarity3(0), fixed))
    for edge in edges:
        units = np.concatenate([np.ones(3), np.full(3, edge.scale), np.ones(1)])
        measured, noise = _similarity(edge.T_from_to, edge.scale), robust_noise(edge.sigmas / units)
        graph.add(gtsam.BetweenFactorSimilarity3(edge.from_index, edge.to_index, measured, noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_MOST_ITERATIONS)
    try:
        solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    except RuntimeError as error:
        raise SlamError(f"the maps cannot be joined: {str(error).strip().partition(chr(10))[0]}") from error
    found = [solved.atSimilarity3(k) for k in range(len(T_world_camera))]
    R = Rotation.from_matrix([each.rotation().matrix() for each in found]).as_matrix()
    scales = np.array([each.scale() for each in found])
    return make(R, scales[:, None] * np.array([each.translation() for each in found])), scales


def _similarity(T_a_b: FloatArray, scale: float) -> Any:
    return gtsam.Similarity3(gtsam.Rot3(T_a_b[:3, :3]), T_a_b[:3, 3] / scale, scale)
