"""GPS tracks of the user: CSV with a header."""

from __future__ import annotations

import csv
import math
import re
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from slam.formats.rows import BadRows, in_seconds, number_or_nan, text_of
from slam.frames import GpsTrack
from slam.runtime.errors import SequenceError

# usual spellings of the columns; the first three are needed
_COLUMNS = {
    "stamp": ("stamp", "time", "timestamp", "t", "seconds"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "lng", "long"),
    "altitude": ("altitude", "alt", "ele", "elevation", "height"),
    "hdop": ("hdop",),
}
_NEEDED = ("stamp", "latitude", "longitude")
# metres a second in the unit of a column of speeds, by the letters of its name
_SPEED_UNITS = {
    **dict.fromkeys(("speed", "speedms", "speedmps"), 1.0),
    **dict.fromkeys(("speedkmh", "speedkph"), 1 / 3.6),
    "speedmph": 0.44704,
    **dict.fromkeys(("speedkn", "speedknots"), 0.514444),
}
_MOST_SPEED_RATIO = 1.5  # of stated speeds and those of the fixes; units differ by more
_LEAST_SPEED_M_S = 5.0  # at which fixes a second apart tell a unit
_EARTH_RADIUS_M = 6.371e6
FASTEST_M_S = 300.0
_LEAST_FIXES = 3  # one step may be an error of one fix
_MOST = np.array([90.0, 180.0, 1e5])


def read_gps(path: Path) -> GpsTrack:
    """Read a GPS track.

    CSV has a header with ``stamp`` in seconds on the clock of the images (times as in ISO 8601 become seconds since
    1970), ``latitude`` and ``longitude`` in degrees and, optionally, ``altitude`` in metres, ``hdop`` and a speed whose
    name says its unit (``speed_kmh``; metres a second without one).

    Raises:
        SequenceError: the file cannot be read, holds no fix, moves at an impossible speed, or states
            speeds that are not those of its fixes.
    """
    text = text_of(path, SequenceError, "a GPS track")
    if text.lstrip().startswith(("<", "$")):
        raise SequenceError(
            f"{path} is XML, such as GPX, or NMEA, which are not read: convert it to CSV ({','.join(_NEEDED)})"
        )
    try:
        found = _fixes(text.splitlines())
    except csv.Error as error:
        raise SequenceError(f"{path} cannot be read as a GPS track: {error}") from error
    if not found:
        raise SequenceError(
            f"{path} holds no GPS fix: CSV with a header {','.join(_NEEDED)} is read"
        )
    bad = BadRows(path, SequenceError)
    rows, table = map(np.array, zip(*found))
    known = table[:, [0, 1, 2, 4] if np.isnan(table[:, 3]).all() else range(5)]
    is_fix = (
        np.isfinite(known).all(axis=1)
        & ~(abs(table[:, 1:4]) > _MOST).any(axis=1)
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
    own = table[np.isfinite(table[:, 5]), 5]
    ratio = np.median(own) / np.median(speeds) if len(own) and len(speeds) else 1.0
    is_fast = len(speeds) > 0 and np.median(speeds) > _LEAST_SPEED_M_S
    if is_fast and not 1 / _MOST_SPEED_RATIO < ratio < _MOST_SPEED_RATIO:
        raise SequenceError(
            f"{path}: its speeds are {ratio:.2f} times those of its fixes: let the column's name say the unit, such "
            "as speed_kmh or speed_mph, or leave it out"
        )
    return GpsTrack(table[:, 0], table[:, 1:4], table[:, 4], table[:, 5])


def _fixes(lines: list[str]) -> list[tuple[int, list[float]]]:
    """Lines with stamp, latitude, longitude, altitude, dilution, speed in m/s.

    NaN where a row is no fix, and where a track has no altitude or no speed.
    """
    delimiter = max(",;\t", key=lines[0].count) if lines else ","
    reader = csv.DictReader(lines, skipinitialspace=True, delimiter=delimiter)
    names: dict[str, str] = {}
    unit = math.nan
    for name in reader.fieldnames or ():
        for column, spellings in _COLUMNS.items():
            if name.strip().lower() in spellings:
                names.setdefault(column, name)
        letters = re.sub("[^a-z]", "", name.lower())
        if letters in _SPEED_UNITS and "speed" not in names:
            names["speed"], unit = name, _SPEED_UNITS[letters]
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise csv.Error(
            f"it lacks {', '.join(missing)}: its first row must name {', '.join(_NEEDED)}"
        )
    rows = []
    for row in reader:
        words = {column: row[name] or "" for column, name in names.items()}
        places = [
            number_or_nan(words.get(name, "")) for name in ("latitude", "longitude", "altitude")
        ]
        dilution = number_or_nan(words.get("hdop") or "1")
        speed = unit * number_or_nan(words.get("speed", ""))
        rows.append((reader.line_num, [_seconds(words["stamp"]), *places, dilution, speed]))
    return rows


def _seconds(word: str) -> float:
    """A stamp as seconds; those of a date in UTC since 1970; NaN where it is neither."""
    seconds = number_or_nan(in_seconds(word))
    with suppress(ValueError):
        if math.isnan(seconds):
            moment = datetime.fromisoformat(word.strip())
            seconds = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    return seconds
