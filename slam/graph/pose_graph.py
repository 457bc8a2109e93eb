"""The pose graph: relative poses in, the most likely trajectory out; also of maps of several units.

GTSAM perturbs a pose on the right, ``T Exp(xi)``, rotation first; the sigmas of a ``RelativePose``
follow that order. A Huber kernel limits outliers: redescending ones do not recover from a drifted
start.

Poses and units of the cameras of several maps are those that agree best with measured similarities,
as in Strasdat et al. 2010: scale drifts along a monocular map, and loops measure how far. GTSAM
writes a similarity as ``p -> s (R p + t)``.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from itertools import compress
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from slam.formats.trajectory import translations_and_quaternions
from slam.frames import LOOP_SOURCE, RelativePose
from slam.geometry.robust import median
from slam.geometry.se3 import BoolArray, FloatArray, invert, is_se3, make, path_distance
from slam.runtime.errors import SlamError
from slam.runtime.files import write_atomically

_ANCHOR_SIGMA = 1e-6
_SPREAD_FRAMES = 8  # by which drift is judged
# of the first pose where positions hold the graph: radians, metres
_LOOSE_SIGMAS = np.repeat([0.3, 1e3], 3)
# whitened residual at which the loss becomes linear: 95 % efficient for normal errors
HUBER_K = 1.345
_LARGEST_RESIDUAL = 8.0  # whitened, of a loop or position that is removed
_OUTLYING = 3.0  # its residual over the median of its kind
_MAX_ITERATIONS = 100  # of Levenberg-Marquardt
# relative decrease of the error below which it ends, of a pose graph and of the units of maps
_RELATIVE_TOLERANCE, _RELATIVE_TOLERANCE_OF_MAPS = 1e-6, 1e-5
# g2o's text format
_TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]
_UPPER = np.triu_indices(6)  # row by row
_VERTEX, _EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"

logger = logging.getLogger(__name__)


class PoseGraph:
    """Camera poses as nodes 0 to N - 1 and relative poses as factors; node 0 is the world frame.

    Attributes:
        relative_poses: the factors in use, in the order they were added.
        dropped: loop factors that were left out: they contradict the rest.
        T_fixed_world: ``(4, 4)``: the world in the axes of the measured positions; the identity
            without any.
    """

    def __init__(self) -> None:
        self.relative_poses: list[RelativePose] = []
        self.dropped: list[RelativePose] = []
        self.T_fixed_world: FloatArray = np.eye(4)
        self._T_world_camera: FloatArray | None = None
        self._positions: list[tuple[int, FloatArray, FloatArray]] = []  # frame, position, sigmas

    def add_relative(self, *relative_poses: RelativePose) -> None:
        """Add measurements as factors.

        Raises:
            SlamError: if one is not a rigid transform, links a frame to itself or to a negative
                one, or lacks six positive sigmas. Then none of them is added.
        """
        for edge in relative_poses:
            name = f"factor {edge.from_index} -> {edge.to_index} ({edge.source})"
            if edge.from_index == edge.to_index or min(edge.from_index, edge.to_index) < 0:
                raise SlamError(f"{name} must link two different frames")
            if not is_se3(edge.T_from_to):
                raise SlamError(f"{name} is not a finite rigid transform")
            for sigmas in (edge.sigmas, edge.graph_sigmas):
                if sigmas.shape != (6,) or not (np.isfinite(sigmas).all() and (sigmas > 0).all()):
                    raise SlamError(f"{name} needs six positive sigmas; got {sigmas}")
        self.relative_poses += relative_poses

    def add_positions(
        self,
        frames: NDArray[np.intp],
        positions: FloatArray,
        sigmas: FloatArray,
        T_fixed_world_initial: FloatArray,
    ) -> None:
        """Add measured positions of cameras as factors.

        Args:
            frames: the nodes, ``(M,)``.
            positions: in axes of their own, metres, ``(M, 3)``.
            sigmas: along these axes, metres, ``(M, 3)``.
            T_fixed_world_initial: where the world lies about in these axes, ``(4, 4)``.
        """
        self._positions += zip(frames.tolist(), positions, sigmas, strict=True)
        self.T_fixed_world = T_fixed_world_initial

    def optimise(self, T_world_camera_initial: FloatArray) -> FloatArray:
        """Solve for all poses from an initial trajectory; the first pose is fixed.

        Args:
            T_world_camera_initial: start ``(N, 4, 4)``, in the unit of the factors.

        Returns:
            ``T_world_camera`` ``(N, 4, 4)``.

        Raises:
            SlamError: if frames are not connected, a factor links a frame beyond the last, the
                start is not rigid, or the system cannot be solved.
        """
        _check_connected(self.relative_poses, len(T_world_camera_initial))
        if not is_se3(T_world_camera_initial):
            raise SlamError(
                "the initial trajectory of the pose graph must be finite rigid transforms"
            )
        values = self._values(T_world_camera_initial)
        solved = _solved(
            self._factors(values), values, _RELATIVE_TOLERANCE, "the pose graph cannot be solved"
        )
        T_fixed_camera = np.stack(
            [solved.atPose3(k).matrix() for k in range(len(T_world_camera_initial))]
        )
        if not np.isfinite(T_fixed_camera).all():
            raise SlamError("the pose graph cannot be solved: the solution is not finite")
        T_fixed_camera[:, :3, :3] = Rotation.from_matrix(T_fixed_camera[:, :3, :3]).as_matrix()
        rebased: FloatArray = T_world_camera_initial[0] @ invert(T_fixed_camera[0]) @ T_fixed_camera
        if self._positions:
            self.T_fixed_world = T_fixed_camera[0] @ invert(T_world_camera_initial[0])
        rebased[0] = T_world_camera_initial[0]
        self._T_world_camera = rebased
        return rebased.copy()

    def drop_contradicted(self) -> bool:
        """Drop loops and positions whose residual is large while that of most is small.

        Residuals are those at the optimised trajectory. Where the odometry is overconfident all
        have large ones. So one must also lie far above the median of its kind.

        Returns:
            Whether one was dropped: optimise again.

        Raises:
            SlamError: if the graph was not optimised.
        """
        T_world_camera = self._solution()
        is_wrong = np.array([edge.source == LOOP_SOURCE for edge in self.relative_poses], bool)
        is_wrong[is_wrong] = _outlying(
            whitened_squared(compress(self.relative_poses, is_wrong), T_world_camera)
        )
        self.dropped += compress(self.relative_poses, is_wrong)
        self.relative_poses = list(compress(self.relative_poses, ~is_wrong))
        placed = (self.T_fixed_world @ T_world_camera)[:, :3, 3]
        away = [(placed[frame] - position) / own for frame, position, own in self._positions]
        is_stray = _outlying(np.square(away).reshape(-1, 3).sum(axis=1))
        self._positions = list(compress(self._positions, ~is_stray))
        if is_stray.any():
            logger.warning(
                "%d of %d positions contradict the others: left out", is_stray.sum(), len(is_stray)
            )
        return bool(is_wrong.any() or is_stray.any())

    def marginal(self, frame: int) -> FloatArray:
        """Covariance ``(6, 6)`` of a frame's pose at the optimised trajectory.

        The first frame is fixed. It is of a perturbation in the camera, ``T_world_camera Exp(xi)``:
        rotation first, radians and the unit of the factors.

        Raises:
            SlamError: there is no such frame, or the graph was not optimised.
        """
        T_world_camera = self._solution()
        if not 0 <= frame < len(T_world_camera):
            raise SlamError(
                f"no frame {frame} in the pose graph: it has 0 to {len(T_world_camera) - 1}"
            )
        return self._covariances(np.array([frame]))[0]

    def drift(self) -> float:
        """Sigma of the positions over the path, root mean square of frames spread over it.

        Raises:
            SlamError: the graph was not optimised.
        """
        T_world_camera = self._solution()
        frames = np.linspace(0, len(T_world_camera) - 1, _SPREAD_FRAMES + 1).astype(int)[1:]
        squared = np.trace(self._covariances(frames)[:, 3:, 3:], axis1=1, axis2=2)
        path = max(float(path_distance(T_world_camera)[-1]), _ANCHOR_SIGMA)
        return float(np.sqrt(np.mean(squared))) / path

    def _covariances(self, frames: NDArray[np.intp]) -> FloatArray:
        """Marginals ``(F, 6, 6)`` of some poses.

        By a sparse LU: GTSAM's Cholesky takes sigmas of 0.06 mm beside those of a metre for a singular system.
        """
        values = self._values(self._solution())
        row, column, entry = self._factors(values).linearize(values).sparseJacobian_()
        count = 6 * values.size()
        is_own = column <= count  # the last column is the residual
        ends = row[is_own].astype(int) - 1, column[is_own].astype(int) - 1
        jacobian = csc_array((entry[is_own], ends), shape=(int(row.max()), count))
        factors = splu((jacobian.T @ jacobian).tocsc())
        unknowns = 6 * frames[:, None] + np.arange(6)
        columns = (unknowns.ravel() == np.arange(count)[:, None]).astype(np.float64)
        solved = factors.solve(columns).reshape(-1, len(frames), 6)
        return np.array([solved[rows, k] for k, rows in enumerate(unknowns)])

    def write_g2o(self, path: Path) -> None:
        """Write the optimised graph in g2o's text format at full precision, atomically.

        Raises:
            SlamError: if the graph was not optimised.
        """
        poses = translations_and_quaternions(self._solution())
        lines = [f"{_VERTEX} {k} {_numbers(pose)}" for k, pose in enumerate(poses)]
        T_from_to = np.array([edge.T_from_to for edge in self.relative_poses]).reshape(-1, 4, 4)
        measured = translations_and_quaternions(T_from_to)
        for edge, pose in zip(self.relative_poses, measured, strict=True):
            ends = f"{edge.from_index} {edge.to_index}"
            information = np.diag(1.0 / edge.graph_sigmas[_TRANSLATION_FIRST] ** 2)[_UPPER]
            lines.append(f"{_EDGE} {ends} {_numbers(pose)} {_numbers(information)}")
        write_atomically(path, "\n".join([*lines, ""]))

    def _solution(self) -> FloatArray:
        if self._T_world_camera is None:
            raise SlamError("the pose graph has not been optimised yet")
        return self._T_world_camera

    def _values(self, T_world_camera: FloatArray) -> Any:
        values = gtsam.Values()
        for k, T in enumerate(self.T_fixed_world @ T_world_camera):
            values.insert(k, gtsam.Pose3(T))
        return values

    def _factors(self, values: Any) -> Any:
        graph = gtsam.NonlinearFactorGraph()
        sigmas = _LOOSE_SIGMAS if self._positions else np.full(6, _ANCHOR_SIGMA)
        graph.add(
            gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Diagonal.Sigmas(sigmas))
        )
        for edge in self.relative_poses:
            noise = robust_noise(edge.graph_sigmas)
            graph.add(
                gtsam.BetweenFactorPose3(
                    edge.from_index, edge.to_index, gtsam.Pose3(edge.T_from_to), noise
                )
            )
        for frame, position, own in self._positions:
            graph.add(gtsam.GPSFactor(frame, position, robust_noise(own)))
        return graph


def whitened_squared(
    relative_poses: Iterable[RelativePose], T_world_camera: FloatArray
) -> FloatArray:
    """Whitened squared 6-dof residual of each measurement at a trajectory ``(N, 4, 4)``, ``(F,)``.

    It is by the sigmas of single measurements: their errors need not be independent.
    """
    squared = []
    for edge in relative_poses:
        T_from_to = invert(T_world_camera[edge.from_index]) @ T_world_camera[edge.to_index]
        residual = gtsam.Pose3.Logmap(gtsam.Pose3(edge.T_from_to).between(gtsam.Pose3(T_from_to)))
        squared.append(float(((residual / edge.sigmas) ** 2).sum()))
    return np.array(squared)


def _outlying(squared: FloatArray) -> BoolArray:
    """Which whitened squared residuals ``(F,)`` are large, and far above the median as well."""
    typical = median(np.sqrt(squared)) if len(squared) else 0.0
    return squared > max(_LARGEST_RESIDUAL, _OUTLYING * typical) ** 2


def _check_connected(relative_poses: Sequence[RelativePose], count: int) -> None:
    ends = np.array([(e.from_index, e.to_index) for e in relative_poses], dtype=int).reshape(-1, 2)
    if len(ends) and (ends.min() < 0 or ends.max() >= count):
        raise SlamError(f"a factor links frame {ends.max()}, but the trajectory has {count} frames")
    links = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    _, component = connected_components(links, directed=False)
    loose = np.flatnonzero(component != component[0])
    if len(loose):
        loose_frames = f"{len(loose)} of {count} frames are not connected to the first"
        raise SlamError(f"{loose_frames}, from frame {loose[0]} on")


def robust_noise(sigmas: FloatArray) -> Any:
    """GTSAM's model of independent errors with these sigmas and Huber's loss."""
    noise: Any = gtsam.noiseModel.Diagonal.Sigmas(np.asarray(sigmas, dtype=np.float64))
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(HUBER_K), noise)


def optimise_similarities(
    T_world_camera: FloatArray,
    scales: FloatArray,
    edges: Sequence[tuple[RelativePose, float, float]],
) -> tuple[FloatArray, FloatArray]:
    """Poses and units of cameras, the first one fixed.

    Args:
        T_world_camera: start ``(K, 4, 4)``.
        scales: start ``(K,)``: units of the world per unit of each camera.
        edges: connect all cameras: a relative pose in the unit of its first camera, the unit of its last one over that,
            and the sigma of its logarithm.

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
    for pose, ratio, sigma in edges:
        noise = robust_noise(np.concatenate([pose.sigmas[:3], pose.sigmas[3:] / ratio, [sigma]]))
        measured = _similarity(pose.T_from_to, ratio)
        graph.add(gtsam.BetweenFactorSimilarity3(*pose.ends, measured, noise))
    solved = _solved(graph, values, _RELATIVE_TOLERANCE_OF_MAPS, "the maps cannot be joined")
    found = [solved.atSimilarity3(k) for k in range(len(T_world_camera))]
    R = Rotation.from_matrix([each.rotation().matrix() for each in found]).as_matrix()
    scales = np.array([each.scale() for each in found])
    return make(R, scales[:, None] * np.array([each.translation() for each in found])), scales


def _solved(graph: Any, values: Any, tolerance: float, failure: str) -> Any:
    """The values that fit a graph best, from a start; ``failure`` begins the sentence of an error.

    Raises:
        SlamError: the system cannot be solved.
    """
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_MAX_ITERATIONS)
    parameters.setRelativeErrorTol(tolerance)
    try:
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        solved = optimiser.optimize()
    except RuntimeError as error:  # GTSAM's IndeterminantLinearSystemException among them
        reason = str(error).strip().partition("\n")[0]
        raise SlamError(f"{failure}: {reason}") from error
    logger.info(
        "pose graph: %d factors, error %.4g to %.4g in %d iterations",
        graph.size(),
        graph.error(values),
        optimiser.error(),
        optimiser.iterations(),
    )
    return solved


def _similarity(T_a_b: FloatArray, scale: float) -> Any:
    return gtsam.Similarity3(gtsam.Rot3(T_a_b[:3, :3]), T_a_b[:3, 3] / scale, scale)


def _numbers(row: FloatArray) -> str:
    """With the shortest digits of an exact round trip."""
    return " ".join(map(repr, row.tolist()))
