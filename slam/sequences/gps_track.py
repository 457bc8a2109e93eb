"""GPS tracks of the user: CSV with a header, or NMEA 0183."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np

from slam.formats.rows import BadRows, in_seconds, text_of
from slam.frames import GpsTrack
from slam.runtime.errors import SequenceError

_COLUMNS = ("stamp", "latitude", "longitude", "altitude")
_DAY_S = 86400.0
_EARTH_RADIUS_M = 6.371e6
FASTEST_M_S = 300.0
_LEAST_FIXES = 3  # one step may be an error of one fix
_MOST = np.array([90.0, 180.0, 1e5])
_NO_FIX = [math.nan] * 5


def read_gps(path: Path) -> GpsTrack:
    """Read a GPS track.

    CSV has a header with ``stamp`` in seconds on the clock of the images, ``latitude`` and ``longitude`` in degrees,
    ``altitude`` in metres and, optionally, ``hdop``. Of NMEA, GGA sentences are read; their stamps are seconds of the
    first day.

    Raises:
        SequenceError: the file cannot be read, holds no fix with an altitude, or moves at an
            impossible speed.
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
    # another column, unit or clock
    if len(table) >= _LEAST_FIXES and np.median(speeds) > FASTEST_M_S:
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
