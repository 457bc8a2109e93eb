"""Where the camera was by other means than its images: true poses at their stamps, and GPS tracks.

True poses are of the recording, as one file a frame, or of a file of the user; GPS tracks are CSV with a header, or
NMEA 0183.
"""

from __future__ import annotations

import csv
import logging
import math
from collections.abc import Iterable
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from erfsfm.common.files import read_text
from slam.formats.rows import BadRows, in_seconds, text_of
from slam.formats.trajectory import other_unit, read_trajectory
from slam.frames import GpsTrack, runs
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError

logger = logging.getLogger(__name__)

_REACH_S, _BRIDGED = (0.1, 0.3), 1.5  # bounds, and in periods of the poses
_FARTHEST = 1e12
_LENGTH_TOLERANCE = 0.1  # of quaternions, which are written with few digits
_ROTATION_TOLERANCE = 0.01  # 7-Scenes writes seven digits, ScanNet six
_COLUMNS = ("stamp", "latitude", "longitude", "altitude")
_DAY_S = 86400.0
_EARTH_RADIUS_M = 6.371e6
FASTEST_M_S = 300.0
_LEAST_FIXES = 3  # one step may be an error of one fix
_MOST = np.array([90.0, 180.0, 1e5])
_NO_FIX = [math.nan] * 5


def rebased(T_any_camera: FloatArray) -> FloatArray:
    """Poses ``T_world_camera`` ``(N, 4, 4)`` whose world is the first camera; the first is the identity."""
    T_any_first = T_any_camera[0].copy()
    T_any_first[:3, :3] = se3.nearest_rotation(T_any_first[:3, :3])
    T_world_camera: FloatArray = se3.invert(T_any_first) @ T_any_camera
    T_world_camera[0] = np.eye(4)
    return T_world_camera


def poses_of(positions: FloatArray, quaternions_xyzw: FloatArray) -> FloatArray:
    """Poses ``(N, 4, 4)`` of positions ``(N, 3)`` and quaternions ``(N, 4)``, which are normalised.

    ``ValueError``: the length of a quaternion is not 1, or a position is not finite or farther than 1e12.
    """
    if not (np.abs(positions) <= _FARTHEST).all():
        raise ValueError(f"a position is not finite, or farther than {_FARTHEST:g}")
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(quaternions_xyzw, axis=1)
    if not (np.abs(lengths - 1) <= _LENGTH_TOLERANCE).all():
        raise ValueError(
            f"a quaternion has length {lengths[np.argmax(~(np.abs(lengths - 1) <= _LENGTH_TOLERANCE))]:g}"
        )
    return se3.make(Rotation.from_quat(quaternions_xyzw).as_matrix(), positions)


def poses_near(
    T_any_camera: FloatArray, known: FloatArray, stamps: FloatArray, path: Path
) -> FloatArray:
    """Interpolated poses ``(N, 4, 4)`` at stamps ``(N,)`` from ``(M, 4, 4)`` of ``path`` at known stamps ``(M,)``.

    The motion goes on at both ends. NaN, with a warning, where the nearest known pose is more than 0.1 s away; of poses
    as rare as images a missing one is bridged, up to 0.3 s.
    """
    if np.array_equal(known, stamps):
        return T_any_camera
    T_near = np.full((len(stamps), 4, 4), np.nan)
    if len(known) > 1:
        reach_s = float(np.clip(_BRIDGED * np.median(np.diff(known)), *_REACH_S))
        first, last = np.searchsorted(
            known, (known[0] + reach_s, known[-1] - reach_s), side="right"
        ) - (0, 1)
        first, last = min(first, len(known) - 1), max(last, 0)
        before = T_any_camera[0] @ se3.invert(T_any_camera[first]) @ T_any_camera[0]
        after = T_any_camera[-1] @ se3.invert(T_any_camera[last]) @ T_any_camera[-1]
        reached = np.r_[2 * known[0] - known[first], known, 2 * known[-1] - known[last]]
        T_near = se3.interpolate(
            np.concatenate([before[None], T_any_camera, after[None]]), reached, stamps
        )
        place = np.clip(np.searchsorted(known, stamps, side="right") - 1, 0, len(known) - 2)
        gap = np.minimum(np.abs(stamps - known[place]), np.abs(known[place + 1] - stamps))
        T_near[gap > reach_s] = np.nan
    are_known = known_poses(T_near)
    if not are_known.all():
        longest = max(
            runs(np.flatnonzero(are_known).tolist()), key=lambda run: run[1] - run[0], default=None
        )
        advice = (
            ""
            if longest is None
            else f"; frames {longest[0]}:{longest[1] + 1} have one each (--frames)"
        )
        missing = int(np.argmin(are_known))
        logger.warning(
            "%s has no pose of image %d: the sequence has no reference%s", path, missing, advice
        )
    return T_near


def known_poses(T_any_camera: FloatArray) -> NDArray[np.bool_]:
    """Which of the poses ``(N, 4, 4)`` are known."""
    return np.asarray(np.isfinite(T_any_camera).all(axis=(1, 2)))


def read_matrix(path: Path, what: str) -> FloatArray:
    """A file of 4 x 4 numbers, which describe what it says."""
    try:
        return np.array(read_text(path).split(), dtype=np.float64).reshape(4, 4)
    except (OSError, ValueError) as error:
        raise SequenceError(f"{path} must hold the 4 x 4 numbers of {what}: {error}") from error


def pose_files(paths: list[Path], stamps: FloatArray) -> FloatArray | None:
    """`poses_near` of files of 4 x 4 numbers, one an image, some of which may be missing; None where all are.

    Numbers that are not finite are those of a camera that lost track.
    """
    there = [
        (stamp, path, read_matrix(path, "a pose"))
        for stamp, path in zip(stamps, paths)
        if path.exists()
    ]
    known, poses = [], []
    for stamp, path, pose in there:
        if not np.isfinite(pose).all():
            continue
        if not se3.is_se3(pose, _ROTATION_TOLERANCE):
            raise SequenceError(f"{path} holds no pose: its 3 x 3 part is not a rotation")
        known.append(stamp)
        poses.append(se3.rigid(pose))
    if not there:
        return None
    return poses_near(np.array(poses).reshape(-1, 4, 4), np.array(known), stamps, paths[0].parent)


def read_truth(path: Path, stamps: FloatArray) -> FloatArray:
    """The true poses ``T_any_camera`` ``(N, 4, 4)`` of images at stamps ``(N,)`` in a file of trajectories, metres.

    Rows with stamps belong to the frames of these times, rows with frame numbers to these frames, and others to the
    frames one by one; NaN where unknown.
    """
    truth, frames = read_trajectory(path), len(stamps)
    numbers = truth.frame_numbers
    if truth.timed:
        T_any_camera = poses_near(truth.T_world_camera, truth.stamps, stamps, path)
    elif truth.numbered or truth.frame_count == frames:
        of_frame = (numbers >= 0) & (numbers < frames)
        known = stamps[numbers[of_frame]]
        T_any_camera = poses_near(truth.T_world_camera[of_frame], known, stamps, path)
    else:
        raise SequenceError(
            f"--truth {path} has {truth.frame_count} rows and the recording {frames} frames: give each frame a row, "
            "or rows with stamps (TUM)"
        )
    cure = other_unit(truth.stamps, stamps) if truth.timed else None
    if cure or not known_poses(T_any_camera).any():
        its, ours = (f"{numbers[0]:.3f} to {numbers[-1]:.3f}" for numbers in (truth.stamps, stamps))
        raise SequenceError(
            f"--truth {path} covers {its} and the recording {ours}: {cure or 'bring both to the same clock'}"
        )
    return T_any_camera


def poses_beside(recording: Path) -> Path | None:
    """A file ``poses*.txt`` in or beside a recording; nothing tells whose poses they are."""
    places = (
        (recording, recording.absolute().parent)
        if recording.is_dir()
        else (recording.absolute().parent,)
    )
    return next((path for place in places for path in sorted(place.glob("poses*.txt"))), None)


def read_gps(path: Path) -> GpsTrack:
    """Read a GPS track.

    CSV has a header with ``stamp`` in seconds on the clock of the images, ``latitude`` and ``longitude`` in degrees,
    ``altitude`` in metres and, optionally, ``hdop``. Of NMEA, GGA sentences are read; their stamps are seconds of the
    first day.
    """
    text = text_of(path, SequenceError, "a GPS track")
    lines = text.splitlines()
    try:
        found = _nmea_rows(lines) if text.lstrip().startswith("$") else _csv_rows(lines, path)
    except csv.Error as error:
        raise SequenceError(f"{path} cannot be read as a GPS track: {error}") from error
    if not found:
        wrong = sum("*" in line and _sentence(line) == [""] for line in lines)
        raise SequenceError(
            f"{path} holds no GPS fix with an altitude: CSV with a header {','.join(_COLUMNS)}, or NMEA is read"
            + (f"; {wrong} sentences have a wrong checksum" if wrong else "")
        )
    bad, rows = BadRows(path, SequenceError), np.array([row for row, _ in found], np.intp)
    table = np.array([fix for _, fix in found], dtype=np.float64)
    is_fix = (
        np.isfinite(table).all(axis=1)
        & (abs(table[:, 1:4]) <= _MOST).all(axis=1)
        & (table[:, 4] > 0)
    )
    needed = "no GPS fix: a stamp, degrees, metres and a dilution above 0 are needed"
    rows, table = bad.without([(is_fix, needed)], rows, table)
    table = table[bad.in_order(table[:, 0], "stamps", rows, "GPS fixes")]
    angles = np.deg2rad(table[:, 1:3])
    steps = np.diff(angles, axis=0)
    steps[:, 1] *= np.cos(angles[1:, 0])
    speeds = _EARTH_RADIUS_M * np.linalg.norm(steps, axis=1) / np.diff(table[:, 0])
    if (
        len(table) >= _LEAST_FIXES and np.median(speeds) > FASTEST_M_S
    ):  # another column, unit or clock
        speed = f"{np.median(speeds):.0f} m/s"
        raise SequenceError(
            f"{path}: its fixes move at {speed}: check its columns, and that stamps are seconds"
        )
    return GpsTrack(table[:, 0], table[:, 1:4], table[:, 4])


def _csv_rows(lines: list[str], path: Path) -> list[tuple[int, list[float]]]:
    """Lines with stamp, latitude, longitude, altitude, dilution; NaN where a row is none."""
    delimiter = max(",;\t", key=lines[0].count) if lines else ","
    reader = csv.DictReader(lines, skipinitialspace=True, delimiter=delimiter)
    missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise SequenceError(
            f"{path} lacks {', '.join(missing)}: its first row must name {', '.join(_COLUMNS)}"
        )
    rows = []
    for row in reader:
        try:
            stamp, *place = (row[name] for name in _COLUMNS)
            numbers = [float(word) for word in (in_seconds(stamp), *place, row.get("hdop") or 1.0)]
        except (TypeError, ValueError):
            numbers = _NO_FIX
        rows.append((reader.line_num, numbers))
    return rows


def _nmea_rows(lines: Iterable[str]) -> list[tuple[int, list[float]]]:
    """The same of GGA sentences with a fix and its altitude; each receiver repeats a fix at most once a stamp."""
    rows: list[tuple[int, list[float]]] = []
    before = -math.inf
    for number, line in enumerate(lines, start=1):
        words = _sentence(line)
        if words[0][-3:] != "GGA" or len(words) < 10 or words[6] in ("", "0") or not words[9]:
            continue
        try:
            clock = words[1]
            stamp = 3600 * int(clock[:2]) + 60 * int(clock[2:4]) + float(clock[4:])
            if stamp < before - _DAY_S / 2:
                stamp += _DAY_S
            place = _degrees(words[2], words[3]), _degrees(words[4], words[5]), float(words[9])
            fix = [stamp, *place, float(words[8] or 1.0)]
        except ValueError:
            fix = _NO_FIX
        if fix[0] != before:
            rows.append((number, fix))
        before = before if math.isnan(fix[0]) else fix[0]
    return rows


def _sentence(line: str) -> list[str]:
    """The words of an NMEA sentence, one empty word where its checksum is wrong."""
    body, star, checksum = line.strip().lstrip("$").partition("*")
    if star and checksum.upper() != f"{reduce(xor, body.encode(), 0):02X}":
        return [""]
    return body.split(",")


def _degrees(word: str, side: str) -> float:
    """Degrees of ``DDMM.MMM`` or ``DDDMM.MMM``, negative south and west."""
    point = word.index(".") if "." in word else len(word)
    degrees = int(word[: point - 2]) + float(word[point - 2 :]) / 60.0
    return -degrees if side in ("S", "W") else degrees
