"""Trajectories: camera poses with time stamps, their KITTI and TUM files, and association by time stamp.

Conventions: ``docs/design/conventions.md``. Quaternions are those of TUM files.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from slam.formats.rows import BadRows, in_seconds, is_number, number_or_nan, rows_of
from slam.geometry import se3
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray, Rows
from slam.runtime.errors import TrajectoryError
from slam.runtime.files import write_atomically

logger = logging.getLogger(__name__)

# columns of a row by format: KITTI's of 3x4 and of 4x4 with a frame number or without, TUM's without a stamp last
_COLUMNS = {"kitti": (12, 13, 16, 17), "tum": (8, 7)}
# a TartanAir camera looks along x, with y to the right and z down
_T_TARTAN_CAMERA = np.array(
    [[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=np.float64
)
_WANTED = "a pose a row"
# Largest |R R^T - I| or | |q| - 1 | that counts as rounding in a file and is repaired.
_ROTATION_TOLERANCE = 1e-3
_FARTHEST = 1e12  # metres: to Saturn
_SAME_STAMP = 0.1  # of the tolerance: stamps of one image differ by less
_UNITS = {1: "milliseconds", 2: "microseconds", 3: "nanoseconds"}  # by powers of 1000
_UNIT_TOLERANCE = 0.2  # of such a power: one of the two covers a quarter at least
_LEAST_OF_OTHER_UNIT = 10  # matching rows, which are by chance
_LONE_PERIOD_S = 0.04  # of a trajectory of one pose


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera poses in time order.

    ``stamps`` ``(N,)`` in seconds, ``T_world_camera`` ``(N, 4, 4)``, metres or the trajectory's own unit.
    ``timed`` is False where the stamps are row numbers, as in a KITTI file; ``numbered`` is True where they are frame
    numbers that the file gives. ``rows`` is the number of rows of a file without either of which bad ones are left out;
    the others keep their row numbers as stamps.
    """

    stamps: FloatArray
    T_world_camera: FloatArray
    timed: bool = True
    numbered: bool = False
    rows: int | None = None

    def __post_init__(self) -> None:
        """Refuse shapes that do not fit, and stamps that are no times."""
        count = len(self.T_world_camera)
        if not count or self.stamps.shape != (count,) or self.T_world_camera.shape != (count, 4, 4):
            raise ValueError(
                "stamps and T_world_camera must have shapes (N,) and (N, 4, 4), N >= 1; "
                f"got {self.stamps.shape} and {self.T_world_camera.shape}"
            )
        if not (np.isfinite(self.stamps).all() and (np.diff(self.stamps) > 0).all()):
            raise ValueError("stamps must be finite and increase")

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def positions(self) -> FloatArray:
        """Camera centres in the world ``(N, 3)``."""
        return self.T_world_camera[:, :3, 3]

    @property
    def length_m(self) -> float:
        """Length of the path through all positions."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    @property
    def frame_count(self) -> int:
        """Number of frames that rows without stamps stand for, those of bad rows among them."""
        return self.rows or len(self)

    @property
    def frame_numbers(self) -> Rows:
        """``(N,)``: those of the file, else the row numbers."""
        by_stamps = self.numbered or self.rows is not None
        return self.stamps.astype(np.intp) if by_stamps else np.arange(len(self))

    def rebased(self) -> Trajectory:
        """The same motion with the first camera as the world: the first pose is the identity."""
        T_first_world = se3.invert(self.T_world_camera[0])
        return replace(self, T_world_camera=T_first_world @ self.T_world_camera)

    def at(self, stamps: FloatArray) -> Trajectory:
        """Interpolated poses of a timed trajectory at stamps ``(M,)``; its ends are held."""
        return Trajectory(stamps, se3.interpolate(self.T_world_camera, self.stamps, stamps))

    def select(self, rows: Rows) -> Trajectory:
        """The poses of some rows, in the order given."""
        return replace(self, stamps=self.stamps[rows], T_world_camera=self.T_world_camera[rows])


def read_trajectory(path: Path | str, format: str = "auto") -> Trajectory:
    """Read a KITTI or a TUM file, or the ``data.csv`` of EuRoC's true poses; ``auto`` decides by the columns.

    A row of KITTI has 12 numbers, or the 16 of a 4x4 matrix, perhaps with the frame number first; one of TUM 8. Rows
    of 7 numbers are TartanVO's: position and quaternion of a camera that looks along x, with z down. EuRoC's columns
    are separated by commas: nanoseconds, position, quaternion w x y z and others. Commas or semicolons may separate
    the columns of all. Stamps are seconds, or whole milli-, micro- or nanoseconds. A header, blank lines and those that
    start with ``#`` are skipped; bad rows are left out (`BadRows`), and where rows have no stamps the others
    keep their numbers. Rotations that are not orthonormal by rounding are replaced by the nearest rotation.

    Raises:
        TrajectoryError: if the file cannot be read as such; the message names file and line.
    """
    path = Path(path)
    if format not in ("auto", *_COLUMNS):
        raise TrajectoryError(f"unknown trajectory format '{format}'; use auto, kitti or tum")
    bad = BadRows(path, TrajectoryError)
    lines, rows, numbers = _read_numbers(
        path, _COLUMNS.get(format, _COLUMNS["kitti"] + _COLUMNS["tum"]), bad
    )
    columns = numbers.shape[1]
    if columns in _COLUMNS["kitti"]:
        T_world_camera = np.tile(np.eye(4), (len(numbers), 1, 1))
        T_world_camera[:, :3] = numbers[:, columns % 4 :][:, :12].reshape(-1, 3, 4)
    else:
        is_unit = np.abs(np.linalg.norm(numbers[:, -4:], axis=1) - 1.0) < _ROTATION_TOLERANCE
        reason = "the quaternion does not have length 1"
        lines, rows, numbers = bad.without([(is_unit, reason)], lines, rows, numbers)
        R_world_camera = Rotation.from_quat(numbers[:, -4:]).as_matrix()
        T_world_camera = se3.make(R_world_camera, numbers[:, -7:-4])
    if columns == 7:
        T_world_camera = _T_TARTAN_CAMERA.T @ T_world_camera @ _T_TARTAN_CAMERA
    is_near = (np.abs(T_world_camera[:, :3, 3]) <= _FARTHEST).all(axis=1)
    R = T_world_camera[:, :3, :3]
    # an overflow becomes NaN, which fails the check
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        is_rotation = (deviation < _ROTATION_TOLERANCE) & (np.linalg.det(R) > 0)
    checks = [
        (is_near, f"a position is farther than {_FARTHEST:g}"),
        (is_rotation, "the 3x3 part is not a rotation matrix"),
    ]
    lines, rows, numbers, T_world_camera = bad.without(checks, lines, rows, numbers, T_world_camera)
    timed, numbered = columns == 8, columns in (13, 17)
    stamps = numbers[:, 0] if timed or numbered else rows.astype(np.float64)
    order = bad.in_order(stamps, "time stamps" if timed else "frame numbers", lines, _WANTED)
    T_world_camera = T_world_camera[order]
    T_world_camera[:, :3, :3] = se3.nearest_rotation(T_world_camera[:, :3, :3])
    count = len(order) + len(bad) if len(bad) and not (timed or numbered) else None
    return Trajectory(stamps[order], T_world_camera, timed, numbered, count)


def write_kitti(path: Path | str, trajectory: Trajectory) -> None:
    """Write the upper 3x4 of each ``T_world_camera``, row by row, atomically; after its number where it has one."""
    rows = trajectory.T_world_camera[:, :3].reshape(len(trajectory), 12)
    begin = "{:.0f} " if trajectory.numbered else ""
    lines = (f"{begin.format(k)}{_row(row)}\n" for k, row in zip(trajectory.stamps, rows))
    write_atomically(Path(path), "".join(lines), TrajectoryError)


def write_tum(path: Path | str, trajectory: Trajectory) -> None:
    """Write ``t tx ty tz qx qy qz qw`` a row, atomically; stamps are written with all their digits."""
    poses = translations_and_quaternions(trajectory.T_world_camera)
    lines = ["# timestamp tx ty tz qx qy qz qw\n"]
    for stamp, pose in zip(trajectory.stamps, poses):
        seconds = np.format_float_positional(stamp, min_digits=9)
        lines.append(f"{seconds} {_row(pose)}\n")
    write_atomically(Path(path), "".join(lines), TrajectoryError)


def translations_and_quaternions(T_a_b: FloatArray) -> FloatArray:
    """Translation and quaternion (xyzw) ``(N, 7)`` of poses ``(N, 4, 4)``."""
    quaternions_xyzw = Rotation.from_matrix(T_a_b[:, :3, :3]).as_quat(canonical=True)
    return np.concatenate([T_a_b[:, :3, 3], quaternions_xyzw], axis=1)


def associate(
    estimate: Trajectory, reference: Trajectory, frames: tuple[int, int] | None = None
) -> tuple[Trajectory, Trajectory]:
    """The rows of both that belong to the same frames, equally many.

    Two timed trajectories are matched one to one by nearest stamps, up to `matching_tolerance_s`; where these stamps
    differ, the denser trajectory is interpolated at those of the other. Otherwise rows are matched by their frame
    numbers where one of the two has them, and else row k belongs to row k.

    Of ``frames`` only these rows [start, stop) of the reference count; an estimate of as many rows is of these frames.

    Args:
        estimate: the trajectory to evaluate.
        reference: the truth.
        frames: rows [start, stop) of the reference that count; None for all.

    Raises:
        TrajectoryError: if the lengths differ and stamps or frame numbers are missing, or none match.
    """
    if not (estimate.timed and reference.timed):
        if frames is not None:
            estimate, reference = _of_frames(estimate, *frames), _of_frames(reference, *frames)
        return _same_frames(estimate, reference)
    if frames is not None:
        reference = reference.select(np.arange(*frames))
    tolerance_s = matching_tolerance_s(estimate, reference)
    # slack, because the tolerance itself is a difference of rounded stamps
    within_s = tolerance_s * (1.0 + 1e-6)
    rows_estimate, rows_reference = nearest_pairs(estimate.stamps, reference.stamps, within_s)
    cure = other_unit(estimate.stamps, reference.stamps)
    if not rows_estimate.size or (cure and len(rows_estimate) < _LEAST_OF_OTHER_UNIT):
        ours, theirs = (
            f"{each.stamps[0]:.3f} to {each.stamps[-1]:.3f} s" for each in (estimate, reference)
        )
        raise TrajectoryError(
            f"no time stamps match within {tolerance_s:.3g} s: the estimate covers {ours} and the reference {theirs}; "
            f"{cure or 'bring both to the same clock'}"
        )
    expected = min(len(estimate), len(reference))
    if rows_estimate.size < 0.9 * expected:
        logger.warning(
            "only %d of %d poses have a matching time stamp", rows_estimate.size, expected
        )
    pair = estimate.select(rows_estimate), reference.select(rows_reference)
    apart = np.abs(pair[0].stamps - pair[1].stamps).max()
    if apart <= _SAME_STAMP * tolerance_s:
        return pair
    if _period_s(estimate) < _period_s(reference):
        return estimate.at(pair[1].stamps), pair[1]
    return pair[0], reference.at(pair[0].stamps)


def other_unit(stamps: FloatArray, others: FloatArray) -> str | None:
    """What to do where two series of stamps of one drive last about 1000, 10^6 or 10^9 times as long; else None."""
    if min(len(stamps), len(others)) < 2:
        return None
    thousands = float(np.log(np.ptp(stamps) / np.ptp(others)) / np.log(1000))
    power = abs(round(thousands))
    if power not in _UNITS or abs(abs(thousands) - power) > _UNIT_TOLERANCE:
        return None
    longer = max(stamps, others, key=np.ptp)
    return (
        f"stamps up to {longer[-1]:.0f} look like {_UNITS[power]}: divide them by {1000**power:.0e}"
    )


def _of_frames(trajectory: Trajectory, start: int, stop: int) -> Trajectory:
    """The frames [start, stop) with their numbers."""
    numbers = trajectory.frame_numbers
    if not trajectory.numbered and trajectory.frame_count == stop - start:
        numbers = numbers + start
    chosen = (numbers >= start) & (numbers < stop)
    if not chosen.any():
        raise TrajectoryError(
            f"there are no poses of frames {start}:{stop}, only {numbers[0]} to {numbers[-1]}"
        )
    return Trajectory(
        numbers[chosen].astype(np.float64),
        trajectory.T_world_camera[chosen],
        timed=False,
        numbered=True,
    )


def _same_frames(estimate: Trajectory, reference: Trajectory) -> tuple[Trajectory, Trajectory]:
    if (
        not (estimate.numbered or reference.numbered)
        and estimate.frame_count != reference.frame_count
    ):
        raise TrajectoryError(
            f"the estimate has {estimate.frame_count} poses and the reference {reference.frame_count}; files without "
            "time stamps are compared row by row: give the frames of the estimate with --frames A:B and "
            "--reference, or a row for each frame, or TUM files for both"
        )
    ours, theirs = estimate.frame_numbers, reference.frame_numbers
    if np.array_equal(ours, theirs):
        return estimate, reference
    _, rows_estimate, rows_reference = np.intersect1d(ours, theirs, return_indices=True)
    if not rows_estimate.size:
        raise TrajectoryError(
            "no frame numbers of the estimate are rows of the reference: give both from frame 0"
        )
    return estimate.select(rows_estimate), reference.select(rows_reference)


def matching_tolerance_s(estimate: Trajectory, reference: Trajectory) -> float:
    """Largest time difference of a matching pair: half the frame period (median) of the denser one."""
    return 0.5 * min(_period_s(estimate), _period_s(reference))


def _period_s(trajectory: Trajectory) -> float:
    return median(np.diff(trajectory.stamps)) if len(trajectory) > 1 else _LONE_PERIOD_S


def nearest_pairs(a: FloatArray, b: FloatArray, within_s: float) -> tuple[Rows, Rows]:
    """Rows of two increasing series of stamps that are each other's nearest and at most ``within_s`` apart.

    Args:
        a: stamps ``(N,)``, increasing.
        b: stamps ``(M,)``, increasing.
        within_s: the most that two of a pair are apart.
    """
    nearest_b, nearest_a = nearest_stamps(a, b), nearest_stamps(b, a)
    rows_a = np.arange(len(a))
    chosen = (nearest_a[nearest_b] == rows_a) & (np.abs(b[nearest_b] - a) <= within_s)
    return rows_a[chosen], nearest_b[chosen]


def nearest_stamps(stamps: FloatArray, candidates: FloatArray) -> Rows:
    """For each stamp ``(N,)`` the row of the nearest of the increasing candidates; of two as near the earlier one."""
    return np.searchsorted((candidates[1:] + candidates[:-1]) / 2, stamps)


def _read_numbers(
    path: Path, forms: tuple[int, ...], bad: BadRows
) -> tuple[Rows, Rows, FloatArray]:
    """Line and row numbers ``(N,)`` of a file, and its table ``(N, columns)`` of the commonest of these forms."""
    table = [(number, _words(line)) for number, line in rows_of(path, TrajectoryError, _WANTED)]
    if table and not any(is_number(word) for word in table[0][1]):
        del table[0]  # a header
    counts = Counter(len(words) for _, words in table)
    columns = max(forms, key=lambda form: counts[form])
    lines, rows, numbers = [], [], []
    for row, (line, words) in enumerate(table):
        values = list(map(number_or_nan, words))
        odd = next((word for word, value in zip(words, values) if not math.isfinite(value)), None)
        if len(words) != columns:
            bad.add(line, f"{len(words)} columns; a KITTI row has 12, a TUM row 8")
        elif odd is not None:
            hint = "; decimals are written with a point" if "," in odd else ""
            bad.add(line, f"not a finite number: {odd!r}{hint}")
        else:
            numbers.append(values)
            lines.append(line)
            rows.append(row)
    return np.array(lines, np.intp), np.array(rows, np.intp), np.array(numbers).reshape(-1, columns)


def _words(line: str) -> list[str]:
    """The words of a row; of EuRoC's the stamp in seconds and the quaternion as TUM has them."""
    separators = [
        separator for separator in ";," if line.count(separator) >= _COLUMNS["tum"][1] - 1
    ]
    words = [word.strip() for word in line.split(separators[0])] if separators else line.split()
    if any(" " in word for word in words):  # a comma for the point
        separators, words = [], line.split()
    if len(words) < _COLUMNS["tum"][0]:
        return words
    stamp = in_seconds(words[0])
    is_euroc = separators and stamp != words[0]
    return [stamp, *words[1:4], *words[5:8], words[4]] if is_euroc else [stamp, *words[1:]]


def _row(values: FloatArray) -> str:
    return " ".join(f"{value:.9e}" for value in values)
