"""Pieces of one recording as one sequence: chapters of a camera, files of a dash cam, split bags, numbered folders."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise

import numpy as np

from slam.frames import Image
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.images import ImageSource
from slam.sequences.loader import Opener
from slam.sequences.recording import RecordedSequence, ScanReader

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


@dataclass(frozen=True)
class _Piece:
    name: str
    drive: tuple[str, str]
    number: int | None
    begins_s: float | None

    @classmethod
    def of(cls, name: str, kind: str) -> _Piece | None:
        for pattern in _PIECES.get(kind, ()):
            if match := pattern.fullmatch(name):
                found = match.groupdict()
                number = int(found["number"] or 0) if "number" in found else None
                digits = re.sub(r"\D", "", found.get("date", "") + found.get("clock", ""))
                try:
                    time = datetime.strptime(digits, "%Y%m%d%H%M%S") if digits else None
                except ValueError:
                    continue
                return cls(name, (found["head"], found["tail"]), number, time.timestamp() if time else None)
        return None

    @property
    def place(self) -> float:
        return self.number or self.begins_s or 0.0


def find_series(kinds: Mapping[str, str]) -> list[list[str]]:
    """Names of the pieces of each recording that has several, in order.

    Args:
        kinds: of recordings, by the names of their files or folders without suffix.
    """
    drives: dict[tuple[str, str, str], list[_Piece]] = {}
    for name, kind in kinds.items():
        piece = _Piece.of(name, kind)
        if piece is not None:
            drives.setdefault((kind, *piece.drive), []).append(piece)
    found = []
    for pieces in drives.values():
        pieces.sort(key=lambda piece: piece.place)
        if len(pieces) < 2:
            continue
        apart = np.diff([piece.place for piece in pieces])
        cuts = [0, *(np.flatnonzero(apart > _LONGEST_PAUSE * np.median(apart)) + 1).tolist(), len(pieces)]
        found += [[piece.name for piece in pieces[a:b]] for a, b in pairwise(cuts)]
    return [names for names in found if len(names) > 1]


class _JoinedImages:
    """The images of several sources, one after the other."""

    def __init__(self, sources: Sequence[ImageSource], ends: FloatArray) -> None:
        self._sources, self._ends = sources, ends
        self.width, self.height = sources[0].width, sources[0].height

    def __len__(self) -> int:
        return int(self._ends[-1])

    def read(self, index: int) -> Image:
        place = int(np.searchsorted(self._ends, index, side="right"))
        return self._sources[place].read(index - (int(self._ends[place - 1]) if place else 0))


def open_series(names: Sequence[str], kind: str, openers: Sequence[Opener]) -> RecordedSequence:
    """Pieces as one recording, at their own stamps where those go on, else one after the other.

    A piece that is missing between two others is a gap, as long as its name says or as the piece before.

    Raises:
        SequenceError, DataError: a piece cannot be opened, or is of another camera.
    """
    parts = [part for part in (opener() for opener in openers) if isinstance(part, RecordedSequence)]
    first = parts[0]
    other = next((part for part in parts if part.intrinsics != first.intrinsics), None)
    if other is not None or len(parts) < len(names):
        odd = names[-1] if other is None else other.name
        raise SequenceError(f"{odd} is of another camera than {first.name}: give one of the files as --dataset")
    logger.info("%s are taken as one recording; give one of the files as --dataset for that alone", ", ".join(names))
    ends = np.cumsum([len(part) for part in parts])
    starts = [0, *ends[:-1].tolist()]
    poses = [np.full((len(part), 4, 4), np.nan) if part.T_any_camera is None else part.T_any_camera for part in parts]
    scans: dict[int, ScanReader] = {}
    for start, part in zip(starts, parts):
        scans |= {start + k: read for k, read in part.scans.items()}
    return RecordedSequence(
        name=names[0],
        images=_JoinedImages([part.images for part in parts], ends),
        camera=first.intrinsics,
        stamps=_stamps(kind, names, [part.stamps for part in parts]),
        sources=tuple(
            replace(source, first=(source.first or 0) - start, length=(source.first or 0) + len(part))
            for start, part in zip(starts, parts)
            for source in part.sources
        ),
        T_any_camera=np.concatenate(poses) if any(part.T_any_camera is not None for part in parts) else None,
        usual_height_m=first.camera_height_m,
        T_camera_lidar=first.T_camera_lidar,
        scans=scans,
    )


def _stamps(kind: str, names: Sequence[str], stamps: Sequence[FloatArray]) -> FloatArray:
    pieces = [_Piece.of(name, kind) for name in names]
    period = float(np.median(np.concatenate([np.diff(each) for each in stamps])))
    joined = [stamps[0]]
    for before, piece, each in zip(pieces, pieces[1:], stamps[1:]):
        last, length_s = joined[-1][-1], joined[-1][-1] - joined[-1][0] + period
        goes_on = last < each[0] < last + _LONGEST_PAUSE * length_s
        start = each[0] if goes_on else last + period
        if not goes_on and kind == "ROS bag":
            raise SequenceError(f"{piece and piece.name} does not go on where the bag before it ends: give one alone")
        if not goes_on and before is not None and piece is not None:
            if before.number is not None and piece.number is not None:
                start += (piece.number - before.number - 1) * length_s
            if before.begins_s is not None and piece.begins_s is not None:
                named = joined[-1][0] + piece.begins_s - before.begins_s
                start = named if named > start + _NAMED_TO_S else start
        if start > last + _LONGEST_PAUSE * period:
            logger.warning("nothing was recorded for %.1f s before %s", start - last, piece and piece.name)
        joined.append(each - each[0] + start)
    return np.concatenate(joined)
