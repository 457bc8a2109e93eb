"""Errors of a trajectory: the object T of ``metrics.json``, with evo as a cross-check.

The paper's snippets, absolute errors under five alignments (Umeyama 1991), KITTI's drift over segments of a given path
length (Geiger et al. 2012) and the errors of single steps; the alignment and the segments also for figures of a run.
This is the only file that imports evo, and only inside a function: all other numbers are computed without it.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from erfsfm.evaluation.pose_metrics import SnippetErrors, snippet_errors, snippets_from_trajectory
from slam.formats.rows import number_or_nan
from slam.formats.trajectory import Trajectory, associate, matching_tolerance_s, read_trajectory
from slam.geometry import se3
from slam.geometry.robust import rms
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import ConfigError, Failed, TrajectoryError
from slam.runtime.files import REFERENCE
from slam.runtime.record import Count, Record, part

IndexArray = NDArray[np.intp]
Alignment = Literal["none", "first", "scale", "6dof", "7dof"]

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
FIGURE_LENGTHS_M = (10.0, 20.0, 50.0, *KITTI_LENGTHS_M)
SEGMENT_STEP = 10
ALIGNMENTS: tuple[Alignment, ...] = get_args(Alignment)
SNIPPET_LENGTH = 5
_SAME_ROTATION = 1e-9  # of the entries of a matrix
_TURNED_DEG = 20.0  # by one of two trajectories, where the other has the same rotation in every row
_STRAIGHT = 0.02  # of the length of a path, across it
_NO_REFERENCE = "there is no reference trajectory"
_NOTHING_MOVES = "neither the estimate nor the reference moves, so there is no error to measure"
_BACKWARDS = Failed("the best scale is negative: the estimate goes the other way")
_OPPOSITE = -0.9  # cosine between the positions of snippets
_REFERENCE_STANDS_STILL = Failed("the reference does not move, so scaling would hide every error")


def aligned(trajectories: Mapping[str, Trajectory]) -> dict[str, Trajectory]:
    """Estimates brought to the reference by the best similarity of positions (Umeyama 1991).

    Without a reference they stay as written, only the network trajectory is brought to the optimised one's scale.
    """
    fits: dict[str, se3.Similarity] = {}
    if REFERENCE in trajectories:
        for name in trajectories.keys() - {REFERENCE}:
            estimate, truth = associate(trajectories[name], trajectories[REFERENCE])
            fits[name] = se3.umeyama(truth.positions, estimate.positions, with_scale=True)
    elif "network" in trajectories and "optimised" in trajectories:
        raw, optimised = associate(trajectories["network"], trajectories["optimised"])
        fits["network"] = _scaling(optimised.positions, raw.positions)
    drawn = dict(trajectories)
    for name, fit in fits.items():
        T_world_camera = fit.apply_to_poses(drawn[name].T_world_camera)
        drawn[name] = replace(drawn[name], T_world_camera=T_world_camera)
    return drawn


def _scaling(positions_reference: FloatArray, positions: FloatArray) -> se3.Similarity:
    """The scale of positions ``(N, 3)`` that fits the reference's best, s = sum(g . p) / sum(p . p)."""
    energy = float((positions**2).sum())
    scale = float((positions_reference * positions).sum()) / energy if energy > 0 else 1.0
    return se3.Similarity(scale, np.eye(3), np.zeros(3))


def paired(trajectories: Mapping[str, Trajectory]) -> Iterator[tuple[str, Trajectory, Trajectory]]:
    """Name, aligned estimate and truth, row by row, of every estimate; a reference is among the trajectories."""
    for name, trajectory in aligned(trajectories).items():
        if name != REFERENCE:
            yield name, *associate(trajectory, trajectories[REFERENCE])


def segment_errors(
    T_world_estimate: FloatArray, T_world_reference: FloatArray, lengths_m: Iterable[float]
) -> list[tuple[float, FloatArray, FloatArray]]:
    """Relative errors of all segments of each length within the true path, starting every ten frames.

    A segment ends at the first frame beyond its length. Lengths without a segment are left out.

    Args:
        T_world_estimate: poses ``(N, 4, 4)``, row k beside row k of the reference, in metres.
        T_world_reference: true poses ``(N, 4, 4)``.
        lengths_m: path lengths, in increasing order.

    Returns:
        Each length, and the errors of its segments ``(S,)``: translation in metres, rotation in radians.
    """
    distance = se3.path_distance(T_world_reference)
    segments = []
    for length_m in lengths_m:
        starts = np.arange(0, len(distance), SEGMENT_STEP)
        ends = np.searchsorted(distance, distance[starts] + length_m, side="right")
        fits = ends < len(distance)
        if not fits.any():
            break
        errors = relative_errors(T_world_estimate, T_world_reference, starts[fits], ends[fits])
        segments.append((length_m, *errors))
    return segments


def relative_errors(
    T_world_estimate: FloatArray,
    T_world_reference: FloatArray,
    starts: IndexArray,
    ends: IndexArray,
) -> tuple[FloatArray, FloatArray]:
    """Translation (metres) and rotation (radians) errors ``(M,)`` of the motions between pairs of rows.

    E = (T_est,i^-1 T_est,j)^-1 (T_ref,i^-1 T_ref,j)      (Geiger et al. 2012, Eqs. 2-3)

    Args:
        T_world_estimate: poses ``(N, 4, 4)``.
        T_world_reference: the true ones ``(N, 4, 4)``, row k beside row k.
        starts: rows where the motions begin ``(M,)``.
        ends: rows where they end ``(M,)``.
    """
    T_start_end_estimate = se3.invert(T_world_estimate[starts]) @ T_world_estimate[ends]
    T_start_end_reference = se3.invert(T_world_reference[starts]) @ T_world_reference[ends]
    T_error = se3.invert(T_start_end_estimate) @ T_start_end_reference
    return np.linalg.norm(T_error[:, :3, 3], axis=1), se3.rotation_angle(T_error[:, :3, :3])


class SnippetMetrics(Record):
    """Errors of snippets of five frames, mean and standard deviation, and their number."""

    ate_mean: float | None = None
    ate_std: float | None = None
    re_mean: float | None = None
    re_std: float | None = None
    count: Count | None = None


@dataclass(frozen=True)
class Aligned:
    """An estimate brought to a reference, both ``(N, 4, 4)`` and with one world."""

    T_world_estimate: FloatArray
    T_world_reference: FloatArray
    scale: float | Failed

    @cached_property
    def step_errors(self) -> tuple[FloatArray, FloatArray]:
        """Translation (metres) and rotation (radians) errors ``(N - 1,)`` from each frame to the next."""
        first = np.arange(len(self.T_world_estimate) - 1)
        return relative_errors(self.T_world_estimate, self.T_world_reference, first, first + 1)

    def drift(
        self, errors_per_m: Callable[[float, FloatArray, FloatArray], FloatArray]
    ) -> float | Failed:
        """KITTI's drift: the mean over all segments of 100 to 800 m of true path."""
        segments = segment_errors(self.T_world_estimate, self.T_world_reference, KITTI_LENGTHS_M)
        if not segments:
            path_m = se3.path_distance(self.T_world_reference)[-1]
            return Failed(
                f"no segment of {KITTI_LENGTHS_M[0]:.0f} m fits into the path of {path_m:.1f} m"
            )
        return float(np.concatenate([errors_per_m(*each) for each in segments]).mean())


class Statistic(NamedTuple):
    """A number under an alignment: its header with the unit, its decimals in tables, and its formula."""

    header: str
    decimals: int
    formula: Callable[[Aligned], float | Failed]


def _ate(pair: Aligned) -> float:
    offsets = pair.T_world_estimate[:, :3, 3] - pair.T_world_reference[:, :3, 3]
    return rms(np.linalg.norm(offsets, axis=1))


_T_REL = Statistic(
    "t_rel\n%", 2, lambda pair: pair.drift(lambda length_m, shift_m, _: 100.0 * shift_m / length_m)
)
_R_REL = Statistic(
    "r_rel\ndeg/100m",
    3,
    lambda pair: pair.drift(lambda length_m, _, turn: 100.0 * np.rad2deg(turn) / length_m),
)
_RPE_M = Statistic("RPE\nm", 4, lambda pair: float(pair.step_errors[0].mean()))
_RPE_DEG = Statistic("RPE\ndeg", 4, lambda pair: float(np.rad2deg(pair.step_errors[1].mean())))
_RPE_RMSE_M = Statistic("rmse\nm", 4, lambda pair: rms(pair.step_errors[0]))
_RPE_RMSE_DEG = Statistic("rmse\ndeg", 4, lambda pair: rms(np.rad2deg(pair.step_errors[1])))


class AlignedMetrics(Record):
    """The object A of ``metrics.json``: errors under one alignment. A metric is a field with its `Statistic`."""

    ate_rmse_m: Annotated[float | None, Statistic("ATE\nm", 3, _ate)] = None
    t_rel_percent: Annotated[float | None, _T_REL] = None
    r_rel_deg_per_100m: Annotated[float | None, _R_REL] = None
    rpe_trans_m: Annotated[float | None, _RPE_M] = None
    rpe_trans_rmse_m: Annotated[float | None, _RPE_RMSE_M] = None
    rpe_rot_deg: Annotated[float | None, _RPE_DEG] = None
    rpe_rot_rmse_deg: Annotated[float | None, _RPE_RMSE_DEG] = None
    scale: Annotated[float | None, Statistic("scale", 4, lambda pair: pair.scale)] = None

    @classmethod
    def statistics(cls) -> dict[str, Statistic]:
        """Of every number, by its key."""
        return {name: cls.model_fields[name].metadata[0] for name in cls.names()}


class Alignments(Record):
    """Errors by alignment."""

    none: AlignedMetrics = part(AlignedMetrics)
    first: AlignedMetrics = part(AlignedMetrics)
    scale: AlignedMetrics = part(AlignedMetrics)
    dof6: AlignedMetrics = part(AlignedMetrics, "6dof")
    dof7: AlignedMetrics = part(AlignedMetrics, "7dof")


class EvoMetrics(Record):
    """Statistics under the alignment ``7dof`` by evo, and their largest difference from ours."""

    ape_rmse_m_7dof: float | None = None
    rpe_trans_m: float | None = None
    rpe_rot_deg: float | None = None
    difference: float | None = None


class TrajectoryMetrics(Record):
    """The object T of ``metrics.json``: all errors of a trajectory."""

    snippet5: SnippetMetrics = part(SnippetMetrics)
    align: Alignments = part(Alignments)
    evo: EvoMetrics = part(EvoMetrics)


def trajectory_metrics(
    estimate: Trajectory, reference: Trajectory | None, snippet5: SnippetErrors | None = None
) -> TrajectoryMetrics:
    """The object T of ``metrics.json`` (``docs/metrics.md``); a number that cannot be computed is missing.

    Args:
        estimate: the trajectory to evaluate.
        reference: the truth of the same frames, row k beside row k (see `slam.formats.trajectory.associate`).
        snippet5: the paper's protocol where it was measured directly; by default cut from the estimate.

    Raises:
        TrajectoryError: if the two have different lengths.
    """
    reason = _why_not(estimate, reference)
    if reference is None or reason:
        snippets = _snippet_metrics(snippet5) if snippet5 else SnippetMetrics.unknown(reason)
        aligned = Alignments.of(**dict.fromkeys(ALIGNMENTS, AlignedMetrics.unknown(reason)))
        return TrajectoryMetrics(snippet5=snippets, align=aligned, evo=EvoMetrics.unknown(reason))
    T_world_estimate, T_world_reference = estimate.T_world_camera, reference.T_world_camera
    unturned = _without_rotations(T_world_estimate, T_world_reference)
    ours = {
        name: _alignment_metrics(T_world_estimate, T_world_reference, name, unturned)
        for name in ALIGNMENTS
    }
    if unturned:
        return TrajectoryMetrics(
            snippet5=SnippetMetrics.unknown(unturned),
            align=Alignments.of(**ours),
            evo=EvoMetrics.unknown(unturned),
        )
    predicted = snippets_from_trajectory(T_world_estimate, SNIPPET_LENGTH)
    true = snippets_from_trajectory(T_world_reference, SNIPPET_LENGTH)
    without_ate = None
    if _stands_still(T_world_reference):
        without_ate = _REFERENCE_STANDS_STILL
    elif snippet5 is None:
        # snippets that point against the true ones, which a negative scale would take for a good fit
        p, g = predicted[..., :3, 3], true[..., :3, 3]
        if (g * p).sum() < _OPPOSITE * np.sqrt((g * g).sum() * (p * p).sum()):
            without_ate = _BACKWARDS
    if snippet5 is None and len(predicted):
        snippet5 = snippet_errors(predicted, true)
    return TrajectoryMetrics(
        snippet5=_snippet_metrics(snippet5, without_ate),
        align=Alignments.of(**ours),
        evo=_evo_metrics(T_world_estimate, T_world_reference, ours["7dof"]),
    )


def align(
    T_world_estimate: FloatArray, T_world_reference: FloatArray, alignment: Alignment
) -> Aligned:
    """Bring an estimate to a reference, both ``(N, 4, 4)``.

    ``none`` as written; ``first`` both rebased to their first pose; ``scale`` then also one factor; ``6dof`` and
    ``7dof`` the best rigid motion and the best similarity of the positions. The scale of an estimate that stands
    still is undefined; it is left as it is.

    Args:
        T_world_estimate: poses ``(N, 4, 4)``.
        T_world_reference: the true ones ``(N, 4, 4)``, row k beside row k.
        alignment: how.
    """
    if alignment in ("first", "scale"):
        T_world_reference = se3.invert(T_world_reference[0]) @ T_world_reference
        T_world_estimate = se3.invert(T_world_estimate[0]) @ T_world_estimate
    scaled = alignment in ("scale", "7dof")
    still = _stands_still(T_world_estimate)
    fit = se3.Similarity(1.0, np.eye(3), np.zeros(3))
    g, p = T_world_reference[:, :3, 3], T_world_estimate[:, :3, 3]
    if alignment in ("6dof", "7dof"):
        fit = se3.umeyama(g, p, with_scale=scaled and not still)
    elif scaled and not still:
        fit = _scaling(g, p)
    scale = (
        Failed("the estimate does not move, so its scale is undefined")
        if scaled and still
        else fit.scale
    )
    return Aligned(fit.apply_to_poses(T_world_estimate), T_world_reference, scale)


def evo_commands(estimate: Path | str, reference: Path | str, format: str = "auto") -> list[str]:
    """The evo commands that give the numbers of ``evo`` for two files.

    None for files of two formats, with bad rows, or with stamps so different that poses are interpolated.

    Args:
        estimate: a file.
        reference: a file.
        format: of both, as `read_trajectory` takes it.

    Raises:
        TrajectoryError: a file cannot be read, or the two do not match.
    """
    a, b = read_trajectory(estimate, format), read_trajectory(reference, format)
    if a.timed != b.timed or a.rows or b.rows:
        return []
    of_a, of_b = associate(a, b)
    if not (np.isin(of_a.stamps, a.stamps).all() and np.isin(of_b.stamps, b.stamps).all()):
        return []
    files = f"{'tum' if a.timed else 'kitti'} {shlex.quote(str(reference))} {shlex.quote(str(estimate))}"
    options = "--align --correct_scale"
    if a.timed:
        options += f" --t_max_diff {matching_tolerance_s(a, b):.9g}"
    steps = f"evo_rpe {files} {options} --delta 1 --delta_unit f --pose_relation"
    return [f"evo_ape {files} {options}", f"{steps} trans_part", f"{steps} angle_deg"]


def exceeded(metrics: TrajectoryMetrics, limits: Sequence[str]) -> list[str]:
    """Metrics of T above their limits, one line each; a missing number counts as above.

    Args:
        metrics: the object T.
        limits: ``METRIC=VALUE`` each; METRIC is a path as ``align.7dof.ate_rmse_m`` or ``snippet5.ate_mean``,
            and a bare name such as ``ate_rmse_m`` means the one under ``7dof``.

    Raises:
        ConfigError: a limit is not METRIC=VALUE, or there is no such metric.
    """
    lines, names = [], AlignedMetrics.names()
    for limit in limits:
        name, _, text = limit.partition("=")
        name = name.strip()
        most = number_or_nan(text)
        if not name or math.isnan(most):
            raise ConfigError(f"a limit is METRIC=VALUE with a number for VALUE; got '{limit}'")
        path = f"align.7dof.{name}" if name in names else name
        try:
            value, reason = metrics.at(path)
        except AttributeError:
            value, reason = "", ""
        if not isinstance(value, float | int | None):
            raise ConfigError(
                f"there is no metric '{name}'; use {', '.join(names)} (under 7dof), "
                f"align.{{{','.join(ALIGNMENTS)}}}.NAME, snippet5.NAME or evo.NAME"
            )
        if value is None:
            lines.append(f"{path} is not known ({reason}), limit {most:g}")
        elif value > most:
            lines.append(f"{path} is {value:.6g}, over the limit {most:g}")
    return lines


def _why_not(estimate: Trajectory, reference: Trajectory | None) -> str:
    """Why the trajectories cannot be compared; empty if they can."""
    if reference is None:
        return _NO_REFERENCE
    if len(estimate) != len(reference):
        raise TrajectoryError(
            f"the estimate has {len(estimate)} poses and the reference {len(reference)}: match them first"
        )
    for name, trajectory in (("estimate", estimate), ("reference", reference)):
        if not np.isfinite(trajectory.T_world_camera).all():
            return f"the {name} has poses that are not finite"
    if (
        len(estimate) > 1
        and _is_constant(estimate.T_world_camera)
        and _is_constant(reference.T_world_camera)
    ):
        return _NOTHING_MOVES
    return ""


def _alignment_metrics(
    T_world_estimate: FloatArray,
    T_world_reference: FloatArray,
    alignment: Alignment,
    unturned: str = "",
) -> AlignedMetrics:
    """The object A: errors of all rows after one alignment; of positions alone where there are no rotations."""
    if unturned and alignment in ("first", "scale"):
        return AlignedMetrics.unknown(unturned)
    # with fewer frames an alignment fits exactly, and its zero error is meaningless
    frames, fewest = len(T_world_estimate), 2 if alignment in ("none", "first") else 3
    if frames < fewest:
        return AlignedMetrics.unknown(f"this alignment needs {fewest} frames; there are {frames}")
    if alignment in ("scale", "7dof") and _stands_still(T_world_reference):
        return AlignedMetrics.unknown(_REFERENCE_STANDS_STILL.reason)
    aligned = align(T_world_estimate, T_world_reference, alignment)
    if not isinstance(aligned.scale, Failed) and aligned.scale <= 0:
        return AlignedMetrics.unknown(_BACKWARDS.reason)
    values = {name: each.formula(aligned) for name, each in AlignedMetrics.statistics().items()}
    if unturned:
        values |= dict.fromkeys(values.keys() - {"ate_rmse_m", "scale"}, Failed(unturned))
    return AlignedMetrics.of(**values)


def _snippet_metrics(
    errors: SnippetErrors | None, without_ate: Failed | None = None
) -> SnippetMetrics:
    if errors is None:
        few = Failed(f"a snippet needs {SNIPPET_LENGTH} frames")
        return SnippetMetrics.of(ate_mean=few, ate_std=few, re_mean=few, re_std=few, count=0)
    return SnippetMetrics.of(
        **asdict(errors)
        | ({"ate_mean": without_ate, "ate_std": without_ate} if without_ate else {})
    )


def _evo_metrics(
    T_world_estimate: FloatArray, T_world_reference: FloatArray, ours: AlignedMetrics
) -> EvoMetrics:
    """The statistics of ``7dof`` again, computed by evo alone, and the largest disagreement with ours."""
    if ours.ate_rmse_m is None:
        return EvoMetrics.unknown(ours.why("ate_rmse_m"))
    from evo import EvoException
    from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType, Unit
    from evo.core.trajectory import PosePath3D

    estimate = PosePath3D(poses_se3=[*T_world_estimate])
    reference = PosePath3D(poses_se3=[*T_world_reference])
    values = {}
    try:
        estimate.align(reference, correct_scale=True)
        for key, metric, statistic in (
            ("ape_rmse_m_7dof", APE(PoseRelation.translation_part), StatisticsType.rmse),
            (
                "rpe_trans_m",
                RPE(PoseRelation.translation_part, 1, Unit.frames),
                StatisticsType.mean,
            ),
            (
                "rpe_rot_deg",
                RPE(PoseRelation.rotation_angle_deg, 1, Unit.frames),
                StatisticsType.mean,
            ),
        ):
            metric.process_data((reference, estimate))
            values[key] = float(metric.get_statistic(statistic))
    except EvoException as error:
        return EvoMetrics.unknown(f"evo fails: {error}")
    pairs = zip(values.values(), (ours.ate_rmse_m, ours.rpe_trans_m, ours.rpe_rot_deg))
    differences = [abs(theirs - mine) for theirs, mine in pairs if mine is not None]
    return EvoMetrics.of(**values, difference=max(differences))


def _without_rotations(T_world_estimate: FloatArray, T_world_reference: FloatArray) -> str:
    """Which trajectory has one rotation in every row of a path that turns, while the other turns; else empty."""
    both = {"reference": T_world_reference, "estimate": T_world_estimate}
    for name, other in (("reference", "estimate"), ("estimate", "reference")):
        R, R_other = both[name][:, :3, :3], both[other][:, :3, :3]
        if np.ptp(R, axis=0).max() > _SAME_ROTATION:
            continue
        positions = both[name][:, :3, 3]
        extents = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
        turned = se3.rotation_angle(R_other[0].T @ R_other).max() > np.deg2rad(_TURNED_DEG)
        if turned and extents[1] > _STRAIGHT * extents[0]:
            return (
                f"the {name} has no rotations: they are the same in every row of a path that turns"
            )
    return ""


def _stands_still(T_world_camera: FloatArray) -> bool:
    """Whether all positions are equal, up to rounding."""
    positions = T_world_camera[:, :3, 3]
    return bool(np.ptp(positions, axis=0).max() <= 1e-12 * max(1.0, np.abs(positions).max()))


def _is_constant(T_world_camera: FloatArray) -> bool:
    """Whether all poses are equal, up to rounding."""
    turned = np.ptp(T_world_camera[:, :3, :3], axis=0).max() > _SAME_ROTATION
    return _stands_still(T_world_camera) and not turned
