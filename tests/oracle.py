"""A predictor from ground truth with simulated errors, to test the system without networks."""

from __future__ import annotations

from collections.abc import Callable, Collection
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.evaluation.trajectory import trajectory_metrics
from slam.frames import DepthMap, Frame, SnippetPoses
from slam.geometry.se3 import FloatArray, from_rotation_vector, invert
from slam.pipeline.estimate import Estimate
from slam.runtime.errors import SlamError

_NOISE_CELL_PX = 32


@dataclass(frozen=True)
class OracleNoise:
    """Simulated errors of an oracle.

    ``rotation_sigma`` (radians) is for a pair one frame apart and grows with the square root of the
    distance; ``translation_relative_sigma`` is relative to the pair's length. ``scale_drift_sigma`` is the step
    of a random walk of the logarithm of the unscaled unit, common to depth and translation.
    ``depth_relative_sigma`` is the relative error of depth, smooth over patches as a network's is.
    """

    rotation_sigma: float = 0.0
    translation_relative_sigma: float = 0.0
    scale_drift_sigma: float = 0.0
    depth_relative_sigma: float = 0.0
    seed: int = 0


class OraclePredictor:
    """Implements ``Predictor`` from ground truth; outputs do not depend on earlier calls."""

    def __init__(
        self,
        T_world_camera: FloatArray,
        depth_of: Callable[[int], NDArray[np.floating]],
        noise: OracleNoise = OracleNoise(),
        unscaled_factor: float = 1.0,
        sources: int = 4,
    ) -> None:
        """Prepare the drift of the scale.

        Args:
            T_world_camera: true poses ``(N, 4, 4)``, metres.
            depth_of: true z-depth ``(H, W)`` of a frame, metres, at the size of its image.
            noise: the errors.
            unscaled_factor: unscaled lengths per metre.
            sources: source frames of a snippet, an even number.
        """
        self.sources = sources
        self._T_world_camera = T_world_camera
        self._depth_of = depth_of
        self._noise = noise
        walk = np.random.default_rng([noise.seed, _Stream.SCALE]).normal(size=len(T_world_camera))
        self._unit = unscaled_factor * np.exp(noise.scale_drift_sigma * np.cumsum(walk))  # (N,)

    def executor(self) -> Executor:
        """One thread."""
        return ThreadPoolExecutor(max_workers=1, thread_name_prefix="oracle")

    def depth(self, frame: Frame) -> DepthMap:
        """True depth in the unscaled unit of its frame, with a smooth relative error."""
        depth = np.asarray(self._depth_of(frame.index), dtype=np.float64) * self._unit[frame.index]
        if self._noise.depth_relative_sigma > 0:
            rng = np.random.default_rng([self._noise.seed, _Stream.DEPTH, frame.index])
            height, width = depth.shape
            coarse = rng.normal(size=(height // _NOISE_CELL_PX + 2, width // _NOISE_CELL_PX + 2))
            smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
            depth = depth * np.exp(self._noise.depth_relative_sigma * smooth)
        return np.asarray(depth, dtype=np.float32)

    def snippet(self, frames: list[Frame]) -> SnippetPoses:
        """True relative poses in the unscaled unit of the target, each with its own error."""
        if len(frames) != self.sources + 1:
            raise SlamError(f"a snippet has {self.sources + 1} frames; got {len(frames)}")
        indices = [frame.index for frame in frames]
        target = indices.pop(self.sources // 2)
        T_source_target = np.stack([self._measure(source, target) for source in indices])
        return SnippetPoses(target, tuple(indices), T_source_target)

    def _measure(self, source: int, target: int) -> FloatArray:
        T_source_target = invert(self._T_world_camera[source]) @ self._T_world_camera[target]
        T_source_target[:3, 3] *= self._unit[target]
        rng = np.random.default_rng([self._noise.seed, _Stream.POSE, target, source])
        growth = np.sqrt(abs(source - target))
        rotation = self._noise.rotation_sigma * growth * rng.normal(size=3)
        length = float(np.linalg.norm(T_source_target[:3, 3]))
        translation = self._noise.translation_relative_sigma * length * rng.normal(size=3)
        return np.asarray(T_source_target @ from_rotation_vector(rotation, translation))


class _Stream(IntEnum):
    """Purpose of a random stream."""

    SCALE = 0
    DEPTH = 1
    POSE = 2


def snippets_of(
    T_world_camera: FloatArray, sources: int = 4, unusable: Collection[int] = ()
) -> list[SnippetPoses]:
    """True snippets, one for each target whose frames are all usable."""
    found, half = [], sources // 2
    for target in range(half, len(T_world_camera) - half):
        around = [k for k in range(target - half, target + half + 1) if k != target]
        if not {target, *around} & set(unusable):
            T_source_target = invert(T_world_camera[around]) @ T_world_camera[target]
            found.append(SnippetPoses(target, tuple(around), T_source_target))
    return found


def ate(result: Estimate, name: str = "optimised") -> float:
    """7-dof, of one of its trajectories, metres."""
    return float(trajectory_metrics(getattr(result, name), result.reference).align.dof7.ate_rmse_m)
