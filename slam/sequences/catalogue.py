"""Opening of sequences: recognises the kind of a data set and chooses a sequence of it.

Pieces of one recording are one sequence: chapters of a camera, files of a dash cam, split bags, numbered folders.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from erfsfm.common.errors import DataError
from erfsfm.common.readers.kitti import drive_name, find_odometry_root
from erfsfm.common.readers.video import VIDEO_SUFFIXES
from slam.frames import Image
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError, sequence_errors
from slam.runtime.imports import import_plug_in, plug_ins
from slam.sequences import kitti, layouts, ros
from slam.sequences.images import ReadImages
from slam.sequences.loader import IMAGES, VIDEO, Asked, Loader, Opener
from slam.sequences.poses import read_truth
from slam.sequences.recording import ArrayReaders, RecordedSequence, frame_range

logger = logging.getLogger(__name__)

KITTI_VARIABLE = "KITTI_ODOMETRY"
KITTI_NAME = "KITTI"

PLUG_INS = "erfsfm_slam.sequences"  # entry points of other packages: each names a `Loader`

# the first that recognises a path opens it; loaders of other packages come before these
LOADERS: tuple[Loader, ...] = (*kitti.LOADERS, *layouts.LOADERS, IMAGES, ros.LOADER, VIDEO)
# by kind of recording: names of pieces, the drive they are of, and their number or the time at which they begin
_PIECES = {
    "video": (
        re.compile(
            r"(?P<head>G)(?:[HXLP](?P<number>\d\d)|OPR)(?P<tail>\d{4})"
        ),  # GoPro; the first of old ones is GOPR
        re.compile(
            r"(?P<head>\D*)(?P<date>\d{4}(?:[-_.]?\d\d){2})[-_ T]*(?P<clock>\d\d(?:[-_.]?\d\d){2})"
            r"(?:[-_]\d+)?(?P<tail>\D*)"
        ),  # dash cams
        re.compile(r"(?P<head>.*(?:part|chapter|segment)[-_ ]?)(?P<number>\d+)(?P<tail>)"),
    ),
    "ROS bag": (re.compile(r"(?P<head>.*?_?)(?:\d{4}(?:-\d\d){5}_)?(?P<number>\d+)(?P<tail>)"),),
    "images": (re.compile(r"(?P<head>)(?P<number>\d{3})(?P<tail>)"),),
}
Contents = dict[str, tuple[str, Opener]]  # kind and opener of each sequence by name
_NAMED_TO_S = 1.5  # names give whole seconds
_TRIP_S = 7200.0  # from the beginning of a clip to that of the next, before another trip begins
_LONGEST_PAUSE = 3.0  # times the usual distance of two pieces, before another drive begins


@sequence_errors()
def open_sequence(
    dataset: Path | None = None,
    name: str | None = None,
    camera: Path | None = None,
    frames: str | None = None,
    truth: Path | None = None,
) -> RecordedSequence:
    """Open a sequence of any kind.

    Args:
        dataset: a data set of one of the ``LOADERS``, or a folder of several, or the word ``KITTI`` for
            ``$KITTI_ODOMETRY``. Without it, a name is searched in ``$KITTI_ODOMETRY``.
        name: which sequence of ``dataset``; optional where there is one only.
        camera: a ``camera.yaml``, or ``fov=DEGREES`` and more; it replaces the calibration of the data set.
        frames: ``A:B``, half-open, as Python reads a slice.
        truth: its true poses, in place of those that the data set has.

    Raises:
        SequenceError: one line on what was searched, where, what was found and what to do.
    """
    sequence = _choose(_root(dataset, name), Asked(name, camera))
    if truth is not None:
        sequence.take_truth(read_truth(truth, sequence.stamps))
    return sequence if frames is None else sequence.cut(*frame_range(frames, len(sequence)))


@sequence_errors()
def sequence_kinds(dataset: Path) -> dict[str, str]:
    """The sequences of a data set by name, and the kind of each; empty where it is of no known kind."""
    return _kinds(_contents(_root(dataset, None), Asked()))


def _root(dataset: Path | None, name: str | None) -> Path:
    """The path given by the user or by the environment."""
    variable = os.environ.get(KITTI_VARIABLE)
    if dataset is None or (str(dataset) == KITTI_NAME and (variable or not dataset.exists())):
        if not variable:
            wanted = f"sequence {name}" if name else f"data set {KITTI_NAME}"
            raise SequenceError(
                f"{wanted} is looked for in ${KITTI_VARIABLE}, which is not set: set it to a KITTI odometry "
                f"root or give --dataset ROOT"
            )
        path, origin = Path(variable).expanduser(), f" (${KITTI_VARIABLE})"
    else:
        path, origin = dataset.expanduser(), ""
    if not path.exists():
        raise SequenceError(f"no data set at {path}{origin}: check the path")
    if not (path.is_file() or path.is_dir()):
        raise SequenceError(f"{path}{origin} is neither a file nor a folder: give a recording")
    return path


def _contents(root: Path, asked: Asked) -> Contents:
    """Kind and opener of what a path holds, pieces of one recording as one; empty where nothing is of a known kind."""
    found = _parts(root, asked)
    for pieces in find_series(_kinds(found)):
        kind, _ = found[pieces[0].name]
        openers = [found.pop(piece.name)[1] for piece in pieces]
        found[pieces[0].name] = kind, partial(open_series, pieces, openers)
    return found


def _kinds(contents: Contents) -> dict[str, str]:
    return {name: kind for name, (kind, _) in contents.items()}


def _parts(root: Path, asked: Asked) -> Contents:
    """What a path holds, or else the folders in it."""
    found = _recognised(root, asked)
    if found or root.is_file():
        return found
    for child in sorted(root.iterdir()):
        if not child.is_dir() or child.name.startswith("."):
            continue
        with suppress(DataError, SequenceError):  # a folder that is refused when it is given
            inside = _recognised(child, Asked(None, asked.camera))
            for name, content in inside.items():
                found[child.name if len(inside) == 1 else f"{child.name}/{name}"] = content
    return found


def _loaders() -> tuple[Loader, ...]:
    return (*map(import_plug_in, plug_ins(PLUG_INS).values()), *LOADERS)


def _recognised(root: Path, asked: Asked) -> Contents:
    for loader in _loaders():
        openers = loader.find(root, asked)
        if openers:
            return {name: (loader.kind, opener) for name, opener in openers.items()}
    return {}


def _choose(root: Path, asked: Asked) -> RecordedSequence:
    """Open the sequence by its name, or the only one."""
    contents, name = _contents(root, asked), asked.name
    if (
        name is not None
        and name not in contents
        and not Path(name).is_absolute()
        and (root / name).exists()
    ):
        return _choose(root / name, Asked(None, asked.camera))
    if not contents:
        raise SequenceError(_unknown(root))
    found = ", ".join(contents)
    if name is None:
        if len(contents) > 1:
            raise SequenceError(
                f"{root} has {len(contents)} sequences: {found}; choose one with --sequence"
            )
        (name,) = contents
    name = drive_name(name) if drive_name(name) in contents else name
    if name not in contents:
        odometry = find_odometry_root(root)
        under = root if odometry is None else odometry.sequences
        raise SequenceError(
            f"no sequence {name} in {root}: found {found} under {under}; choose one of them with --sequence"
        )
    return contents[name][1]()


def _unknown(root: Path) -> str:
    if root.is_file():
        known = ", ".join(suffix[1:] for suffix in VIDEO_SUFFIXES)
        return f"{root} is no video ({known}) and no bag (bag, db3, mcap): give one, or the folder of a data set"
    odometry = find_odometry_root(root)
    if odometry is not None:
        return (
            f"no sequence with images under {odometry.sequences}: looked for png or jpg in */image_2, image_3, "
            f"image_0, image_1; found {_listed(odometry.sequences)}; unpack the images there"
        )
    looked = ", ".join(f"{loader.layout} ({loader.kind})" for loader in _loaders())
    return f"{root} is no data set: looked for {looked}; found {_listed(root)}; check the path"


def _listed(folder: Path) -> str:
    names = sorted(path.name for path in folder.iterdir())
    shown = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    return shown or "an empty folder"


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
                    time = datetime.strptime(
                        re.sub(r"\D", "", found["date"] + found["clock"]), "%Y%m%d%H%M%S"
                    )
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
        longest = min(_LONGEST_PAUSE * np.median(apart), _TRIP_S)
        cuts = [0, *(np.flatnonzero(apart > longest) + 1).tolist(), len(pieces)]
        found += [pieces[a:b] for a, b in pairwise(cuts) if b > a + 1]
    return found


def open_series(pieces: Sequence[Piece], openers: Sequence[Opener]) -> RecordedSequence:
    """Pieces as one recording, at their own stamps where those go on, else one after the other.

    A piece that is missing between two others is a gap, as long as its name says or as the piece before. Clips much
    shorter than the regular distance of their names follow each other: their names do not tell when they begin.

    Args:
        pieces: of one recording, in order.
        openers: what opens each piece.

    Raises:
        SequenceError: a piece is of another camera, or a bag does not go on where the one before it
            ends.
    """
    parts = [opener() for opener in openers]
    first = parts[0]
    for part in parts:
        if part.intrinsics != first.intrinsics:
            raise SequenceError(
                f"{part.name} is of another camera than {first.name}: give one of the files as --dataset"
            )
    logger.info(
        "%s are taken as one recording; give one of the files as --dataset for that alone",
        ", ".join(piece.name for piece in pieces),
    )
    ends = np.cumsum([len(part) for part in parts])
    starts = [0, *ends[:-1].tolist()]
    poses = [
        np.full((len(part), 4, 4), np.nan) if part.T_any_camera is None else part.T_any_camera
        for part in parts
    ]

    sources = []
    scans: ArrayReaders = {}
    for start, part in zip(starts, parts, strict=True):
        for source in part.sources:
            begin = source.first or 0
            sources.append(replace(source, first=begin - start, length=begin + len(part)))
        for k, scan in part.scans.items():
            scans[start + k] = scan

    def read(index: int) -> Image:
        place = int(np.searchsorted(ends, index, side="right"))
        return parts[place].images.read(index - starts[place])

    return RecordedSequence(
        name=pieces[0].name,
        images=ReadImages(first.images.width, first.images.height, int(ends[-1]), read),
        camera=first.camera,
        stamps=_stamps(pieces, [part.stamps for part in parts]),
        sources=tuple(sources),
        T_any_camera=np.concatenate(poses),
        usual_height_m=first.camera_height_m,
        T_camera_lidar=first.T_camera_lidar,
        scans=scans,
    )


def _stamps(pieces: Sequence[Piece], stamps: Sequence[FloatArray]) -> FloatArray:
    period = median(np.concatenate([np.diff(each) for each in stamps]))
    tick_s = _tick_s(pieces, max(float(np.ptp(each)) for each in stamps))
    joined = [stamps[0]]
    for before, piece, each in zip(pieces, pieces[1:], stamps[1:]):
        last, length_s, apart = (
            joined[-1][-1],
            np.ptp(joined[-1]) + period,
            piece.place - before.place,
        )
        start = last + period
        if last < each[0] < last + _LONGEST_PAUSE * length_s:
            start = each[0]
        elif piece.drive[0] == "ROS bag":
            raise SequenceError(
                f"{piece.name} does not go on where the bag before it ends: give one alone"
            )
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
    logger.warning(
        "clips of %.1f s are named %.0f s apart: taken as following each other", longest_s, tick_s
    )
    return tick_s
