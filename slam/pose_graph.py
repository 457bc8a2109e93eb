"""The pose graph: relative poses in, the trajectory that explains them best out.

GTSAM perturbs a pose on the right, ``T Exp(xi)``, rotation first; the sigmas of a ``RelativePose`` follow
that order. Gross outliers are met by a Huber kernel: redescending kernels do not come back from a drifted
start, so Cauchy is only offered as a polish of the Huber result.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from slam.config import PoseGraphConfig
from slam.errors import SlamError
from slam.files import write_atomically
from slam.frames import LOOP_SOURCE, RelativePose
from slam.se3 import FloatArray, invert, is_se3

_ANCHOR_SIGMA = 1e-6
_OUTLYING = 3.0
_TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]

logger = logging.getLogger(__name__)


class PoseGraph:
    """Camera poses as nodes 0 to N - 1 and relative poses as factors; node 0 holds the world."""

    def __init__(self, config: PoseGraphConfig) -> None:
        self._config = config
        self._relative_poses: list[RelativePose] = []
        self._dropped: list[RelativePose] = []
        self._T_world_camera: FloatArray | None = None

    @property
    def relative_poses(self) -> tuple[RelativePose, ...]:
        """The factors in use, in the order they were added."""
        return tuple(self._relative_poses)

    @property
    def dropped(self) -> tuple[RelativePose, ...]:
        """Loop edges given up: the system could not be solved with them, or they contradict the rest."""
        return tuple(self._dropped)

    @property
    def errors(self) -> FloatArray:
        """Whitened squared residual ``(F,)`` of each factor at the optimised trajectory."""
        return whitened_squared(self._relative_poses, self._solution())

    def add_relative(self, *relative_poses: RelativePose) -> None:
        """Add measurements as factors.

        Raises:
            SlamError: if one is not a rigid transform, links a frame to itself or has no positive sigmas.
        """
        for relative_pose in relative_poses:
            _check(relative_pose)
        self._relative_poses += relative_poses

    def optimise(self, T_world_camera_initial: FloatArray) -> FloatArray:
        """Solve for all poses from an initial trajectory; the first pose stays where it is.

        Args:
            T_world_camera_initial: start ``(N, 4, 4)``, in the unit of the factors.

        Returns:
            ``T_world_camera`` ``(N, 4, 4)``.

        Raises:
            SlamError: if frames are not connected or the system cannot be solved.
        """
        self._check_connected(len(T_world_camera_initial))
        if not is_se3(T_world_camera_initial, tolerance=1e-5):
            raise SlamError("the initial trajectory of the pose graph must be finite rigid transforms")
        for _ in range(self._config.max_dropped_loops + 1):
            try:
                self._T_world_camera = self._solve(T_world_camera_initial)
                return self._T_world_camera.copy()
            except RuntimeError as error:  # GTSAM's IndeterminantLinearSystemException among them
                reason = str(error).strip().partition("\n")[0]
                self._drop_newest_loop(reason)
                self._check_connected(len(T_world_camera_initial))
        raise SlamError(f"the pose graph cannot be solved even without {len(self._dropped)} loop edges")

    def drop_contradicted_loops(self) -> tuple[RelativePose, ...]:
        """Give up the loops that the optimised trajectory could not meet while it met most others.

        Where all loops pull together against an overconfident odometry none is to blame: a loop must also lie
        far outside what the middle one shows.

        Returns:
            The loops given up; where there are any, optimise again.
        """
        squared = self.errors
        is_loop = np.array([edge.source == LOOP_SOURCE for edge in self._relative_poses], dtype=bool)
        if not is_loop.any():
            return ()
        typical = float(np.median(np.sqrt(squared[is_loop])))
        limit = max(self._config.max_loop_residual, _OUTLYING * typical)
        beyond = is_loop & (squared > limit**2)
        gone = tuple(edge for edge, out in zip(self._relative_poses, beyond, strict=True) if out)
        self._relative_poses = [edge for edge, out in zip(self._relative_poses, beyond, strict=True) if not out]
        self._dropped += gone
        return gone

    def write_g2o(self, path: Path) -> None:
        """Write the optimised graph in g2o's text format at full precision, atomically."""
        vertices = _g2o_poses(self._solution())
        T_from_to = np.array([edge.T_from_to for edge in self._relative_poses]).reshape(-1, 4, 4)
        edges = _g2o_poses(T_from_to)
        lines = [f"VERTEX_SE3:QUAT {k} {pose}" for k, pose in enumerate(vertices)]
        lines += [
            f"EDGE_SE3:QUAT {edge.from_index} {edge.to_index} {pose} {_g2o_information(edge.sigmas)}"
            for edge, pose in zip(self._relative_poses, edges, strict=True)
        ]
        text = "\n".join(lines) + "\n"
        write_atomically(path, lambda file: file.write_text(text, encoding="ascii"))

    def _solution(self) -> FloatArray:
        if self._T_world_camera is None:
            raise SlamError("the pose graph has not been optimised yet")
        return self._T_world_camera

    def _solve(self, T_world_camera_initial: FloatArray) -> FloatArray:
        values = gtsam.Values()
        for k, T in enumerate(T_world_camera_initial):
            values.insert(k, _pose3(T))
        stages = {"none": ["none"], "huber": ["huber"], "huber-cauchy": ["huber", "cauchy"]}
        for kernel in stages[self._config.kernel]:
            values = self._minimise(values, kernel)
        T_world_camera = np.stack([values.atPose3(k).matrix() for k in range(len(T_world_camera_initial))])
        if not np.isfinite(T_world_camera).all():
            raise RuntimeError("the solution is not finite")
        T_world_camera[:, :3, :3] = Rotation.from_matrix(T_world_camera[:, :3, :3]).as_matrix()
        rebased: FloatArray = T_world_camera_initial[0] @ invert(T_world_camera[0]) @ T_world_camera
        rebased[0] = T_world_camera_initial[0]
        return rebased

    def _minimise(self, values: Any, kernel: str) -> Any:
        graph = gtsam.NonlinearFactorGraph()
        anchor = gtsam.noiseModel.Isotropic.Sigma(6, _ANCHOR_SIGMA)
        graph.add(gtsam.PriorFactorPose3(0, values.atPose3(0), anchor))
        for edge in self._relative_poses:
            noise = self._noise(edge.sigmas, kernel)
            graph.add(gtsam.BetweenFactorPose3(edge.from_index, edge.to_index, _pose3(edge.T_from_to), noise))
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(self._config.max_iterations)
        parameters.setRelativeErrorTol(self._config.relative_tolerance)
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        solved = optimiser.optimize()
        logger.info(
            "pose graph (%s): %d factors, error %.4g to %.4g in %d iterations",
            kernel,
            len(self._relative_poses),
            graph.error(values),
            optimiser.error(),
            optimiser.iterations(),
        )
        return solved

    def _noise(self, sigmas: FloatArray, kernel: str) -> Any:
        diagonal = gtsam.noiseModel.Diagonal.Sigmas(np.asarray(sigmas, dtype=np.float64))
        if kernel == "none":
            return diagonal
        estimators = gtsam.noiseModel.mEstimator
        estimator = (
            estimators.Huber.Create(self._config.huber_k)
            if kernel == "huber"
            else estimators.Cauchy.Create(self._config.cauchy_k)
        )
        return gtsam.noiseModel.Robust.Create(estimator, diagonal)

    def _drop_newest_loop(self, reason: str) -> None:
        loops = [k for k, edge in enumerate(self._relative_poses) if edge.source == LOOP_SOURCE]
        if not loops:
            raise SlamError(f"the pose graph cannot be solved: {reason}")
        edge = self._relative_poses.pop(loops[-1])
        self._dropped.append(edge)
        logger.warning("loop %d -> %d dropped from the graph: %s", edge.from_index, edge.to_index, reason)

    def _check_connected(self, count: int) -> None:
        ends = np.array([(e.from_index, e.to_index) for e in self._relative_poses], dtype=int).reshape(-1, 2)
        if len(ends) and (ends.min() < 0 or ends.max() >= count):
            raise SlamError(f"a factor links frame {ends.max()}, but the trajectory has {count} frames")
        links = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
        _, component = connected_components(links, directed=False)
        loose = np.flatnonzero(component != component[0])
        if len(loose):
            raise SlamError(f"{len(loose)} of {count} frames are not connected to the first, from frame {loose[0]} on")


def whitened_squared(relative_poses: Iterable[RelativePose], T_world_camera: FloatArray) -> FloatArray:
    """Whitened squared 6-dof residual ``(F,)`` of each measurement at a trajectory ``(N, 4, 4)``."""
    squared = []
    for edge in relative_poses:
        T_from_to = invert(T_world_camera[edge.from_index]) @ T_world_camera[edge.to_index]
        residual = gtsam.Pose3.Logmap(_pose3(edge.T_from_to).between(_pose3(T_from_to)))
        squared.append(float(((residual / edge.sigmas) ** 2).sum()))
    return np.array(squared)


def coverage(relative_poses: Sequence[RelativePose], T_world_camera_true: FloatArray, scale: float) -> dict[str, float]:
    """Share of factors whose residual at the truth lies inside the 50, 90 and 95 % quantile of chi-square(6).

    Args:
        relative_poses: measurements with their sigmas, at least one.
        T_world_camera_true: truth ``(N, 4, 4)``, metres.
        scale: units of the measurements per metre; brings the truth to their scale.

    Raises:
        SlamError: if there is no measurement or the scale is not positive.
    """
    if not relative_poses or not scale > 0:
        raise SlamError(f"coverage needs factors and a positive scale; got {len(relative_poses)} and {scale}")
    T_world_camera = T_world_camera_true.copy()
    T_world_camera[:, :3, 3] *= scale
    squared = whitened_squared(relative_poses, T_world_camera)
    return {str(level): float((squared <= chi2.ppf(level / 100, 6)).mean()) for level in (50, 90, 95)}


def _check(edge: RelativePose) -> None:
    name = f"factor {edge.from_index} -> {edge.to_index} ({edge.source})"
    if edge.from_index == edge.to_index or min(edge.from_index, edge.to_index) < 0:
        raise SlamError(f"{name} must link two different frames")
    if not is_se3(edge.T_from_to, tolerance=1e-5):
        raise SlamError(f"{name} is not a finite rigid transform")
    if edge.sigmas.shape != (6,) or not (np.isfinite(edge.sigmas).all() and (edge.sigmas > 0).all()):
        raise SlamError(f"{name} needs six positive sigmas; got {edge.sigmas}")


def _pose3(T_a_b: FloatArray) -> Any:
    return gtsam.Pose3(gtsam.Rot3(T_a_b[:3, :3]), T_a_b[:3, 3])


def _g2o_poses(T_a_b: FloatArray) -> list[str]:
    """Translation and quaternion (xyzw) of poses ``(N, 4, 4)``, shortest digits that read back exactly."""
    if len(T_a_b) == 0:
        return []
    quaternions_xyzw = Rotation.from_matrix(T_a_b[:, :3, :3]).as_quat(canonical=True)
    rows = np.concatenate([T_a_b[:, :3, 3], quaternions_xyzw], axis=1)
    return [_numbers(row) for row in rows]


def _g2o_information(sigmas: FloatArray) -> str:
    """Upper triangle row by row; g2o puts translation first."""
    information = np.diag(1.0 / sigmas[_TRANSLATION_FIRST] ** 2)
    return _numbers(information[np.triu_indices(6)])


def _numbers(row: FloatArray) -> str:
    return " ".join(map(repr, row.tolist()))

