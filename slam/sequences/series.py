"""Pieces of one recording as one sequence: chapters of a camera, files of a dash cam, split bags, numbered folders."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from slam.frames import Image
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.images import ReadImages
from slam.sequences.loader import Opener
from slam.sequences.recording import RecordedSequence

logger = logging.getLogger(__name__)

# by kind of recording: names of pieces, the drive they are of, and their number or the time at which they begin
_PIECES = {
    "video": (
        re.compile(r"(?P<head>G)(?:[HXLP](?P<number>\d\d)|OPR)(?P<tail>\d{4})"),  # GoPro; the first of old ones is GOPR
        re.compile(
            r"(?P<head>\D*)(?P<date>\d{4}(?:[-_.]?\d\d){2})[-_ T]*(?P<clock>\d\d(?:[-_.]?\d\d){2})"
            r"(?:[-_]\d+)?(?P<tail>\D*)"
        ),  # dash cams
        re.compile(r"(?P<head>.*(?:part|chapter|segment)[-_ ]?)(?P<number>\d+)(?P<tail>)"),
    ),
    "ROS bag": (re.compile(r"(?P<head>.*?_?)(?:\d{4}(?:-\d\d){5}_)?(?P<number>\d+)(?P<tail>)"),),
    "images": (re.compile(r"(?P<head>)(?P<number>\d{3})(?P<tail>)"),),
}
_NAMED_TO_S = 1.5  # names give whole seconds
_LONGEST_PAUSE = 3.0  # times the usual distance of two pieces, before another drive begins


class Piece(NamedTuple):
    """A file or folder of a ``drive``, and its ``place`` in it: a number, or the time in seconds at which it begins."""

    name: str
    drive: tuple[str, str, str]
    place: float
    is_time: bool

    @classmethod
    def of(cls, name: str, kind: str) -> Piece | None:
        """The piece of this name; None where it is named as a whole recording."""
        for pattern in _PIECES.get(kind, ()):
            if match := pattern.fullmatch(name):
                found = match.groupdict()
                drive = kind, found["head"], found["tail"]
                if "date" not in found:
                    return cls(name, drive, int(found["number"] or 0), False)
                with suppress(ValueError):  # no date
                    time = datetime.strptime(re.sub(r"\D", "", found["date"] + found["clock"]), "%Y%m%d%H%M%S")
                    return cls(name, drive, time.timestamp(), True)
        return None


def find_series(kinds: Mapping[str, str]) -> list[list[Piece]]:
    """The pieces of each recording that has several, in order; ``kinds`` are by names of files without suffix."""
    drives: dict[tuple[str, str, str], list[Piece]] = {}
    for name, kind in kinds.items():
        if piece := Piece.of(name, kind):
            drives.setdefault(piece.drive, []).append(piece)
    found = []
    for pieces in drives.values():
        if len(pieces) < 2:
            continue
        pieces.sort(key=lambda piece: piece.place)
        apart = np.diff([piece.place for piece in pieces])
        cuts = [0, *(np.flatnonzero(apart > _LONGEST_PAUSE * np.median(apart)) + 1).tolist(), len(pieces)]
        found += [pieces[a:b] for a, b in pairwise(cuts) if b > a + 1]
    return found


def open_series(pieces: Sequence[Piece], openers: Sequence[Opener]) -> RecordedSequence:
    """Pieces as one recording, at their own stamps where those go on, else one after the other.

    A piece that is missing between two others is a gap, as long as its name says or as the piece before. Clips much
    shorter than the regular distance of their names follow each other: their names do not tell when they begin.
    """
    parts = [opener() for opener in openers]
    first = parts[0]
    other = next((part for part in parts if part.intrinsics != first.intrinsics), None)
    if other is not None:
        raise SequenceError(f"{other.name} is of another camera than {first.name}: give one of the files as --dataset")
    logger.info(
        "%s are taken as one recording; give one of the files as --dataset for that alone",
        ", ".join(piece.name for piece in pieces),
    )
    ends = np.cumsum([len(part) for part in parts])
    starts = [0, *ends[:-1].tolist()]
    poses = [np.full((len(part), 4, 4), np.nan) if part.T_any_camera is None else part.T_any_camera for part in parts]

    def read(index: int) -> Image:
        place = int(np.searchsorted(ends, index, side="right"))
        return parts[place].images.read(index - starts[place])

    return RecordedSequence(
        name=pieces[0].name,
        images=ReadImages(first.images.width, first.images.height, int(ends[-1]), read),
        camera=first.camera,
        stamps=_stamps(pieces, [part.stamps for part in parts]),
        sources=tuple(
            replace(source, first=(source.first or 0) - start, length=(source.first or 0) + len(part))
            for start, part in zip(starts, parts)
            for source in part.sources
        ),
        T_any_camera=np.concatenate(poses) if any(part.T_any_camera is not None for part in parts) else None,
        usual_height_m=first.camera_height_m,
        T_camera_lidar=first.T_camera_lidar,
        scans={start + k: scan for start, part in zip(starts, parts) for k, scan in part.scans.items()},
    )


def _stamps(pieces: Sequence[Piece], stamps: Sequence[FloatArray]) -> FloatArray:
    period = float(np.median(np.concatenate([np.diff(each) for each in stamps])))
    tick_s = _tick_s(pieces, max(float(np.ptp(each)) for each in stamps))
    joined = [stamps[0]]
    for before, piece, each in zip(pieces, pieces[1:], stamps[1:]):
        last, length_s, apart = joined[-1][-1], np.ptp(joined[-1]) + period, piece.place - before.place
        start = last + period
        if last < each[0] < last + _LONGEST_PAUSE * length_s:
            start = each[0]
        elif piece.drive[0] == "ROS bag":
            raise SequenceError(f"{piece.name} does not go on where the bag before it ends: give one alone")
        elif piece.is_time and tick_s is None:
            named = joined[-1][0] + apart
            start = named if named > start + _NAMED_TO_S else start
        else:
            start += (round(apart / (tick_s or 1)) - 1) * length_s
        if start > last + _LONGEST_PAUSE * period:
            logger.warning("nothing was recorded for %.1f s before %s", start - last, piece.name)
        joined.append(each - each[0] + start)
    return np.concatenate(joined)


def _tick_s(pieces: Sequence[Piece], longest_s: float) -> float | None:
    """The regular distance of names that are times, where it is much longer than the pieces; else None."""
    apart = np.diff([piece.place for piece in pieces])
    tick_s = float(apart.min())
    is_regular = (apart < tick_s + _NAMED_TO_S).sum() > 1
    if not (pieces[0].is_time and is_regular and tick_s > _LONGEST_PAUSE * longest_s):
        return None
    logger.warning("clips of %.1f s are named %.0f s apart: taken as following each other", longest_s, tick_s)
    return tick_s
