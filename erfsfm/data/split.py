"""Which recordings, and which of their frames, train, validate and test: by a file and by the configuration.

Names are those of `erfsfm.common.readers.frame_range`.

The shipped ones lie in ``configs/splits``. Single frames are written as runs: ``[0:64:3, 69, 72]`` are the frames
0, 3, ..., 63, 69 and 72.

Frames in which the camera stands still are left out (`erfsfm.data.standstill`).
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from pydantic import Field

from erfsfm.common.config_tree import Section, read_model
from erfsfm.common.errors import DataError
from erfsfm.common.readers.camera_file import is_auto
from erfsfm.common.readers.frame_range import EVERYTHING, KINDS, FrameRange
from erfsfm.config import EIGEN, DataConfig, config_folders
from erfsfm.data.discovery import discover
from erfsfm.data.many_view_teacher import scene_of
from erfsfm.data.recordings import Recording
from erfsfm.data.standstill import moving_parts

logger = logging.getLogger(__name__)

_SHORTEST_STOP = 10  # frames of an own recording
_SHORTEST_END = 20  # frames: fewer give neither a trajectory with its scale nor depth by many views
_DEFAULT_VALIDATION = (
    DataConfig().validation
)  # may match no recording: the data need not be simulated
_FRAMES = re.compile(r"(?P<recording>.+)\[(?P<runs>[\d:, ]+)\]")
_RUN = re.compile(r"(?P<first>\d+)(?::(?P<stop>\d+)(?::(?P<step>[1-9]\d*))?)?")


class Split(Section):
    """A division of recordings; a missing list is empty."""

    train: list[str] = Field(
        default_factory=list, description="recordings or frame ranges; none: all that are found"
    )
    validation: list[str] = Field(
        default_factory=list, description="recordings or frame ranges that only validate"
    )
    test: list[str] = Field(default_factory=list, description="recordings or single frames")

    @property
    def test_recordings(self) -> list[str]:
        """Recordings with a frame to test on, without their frames."""
        return [name.partition("[")[0].strip() for name in self.test]

    def test_frames(self) -> list[tuple[str, int]]:
        """Every single frame to test on: its recording and number.

        Raises:
            DataError: a name without single frames.
        """
        frames: list[tuple[str, int]] = []
        for name in self.test:
            match = _FRAMES.fullmatch(name.strip())
            runs = (
                [_RUN.fullmatch(text.strip()) for text in match["runs"].split(",")] if match else []
            )
            if match is None or None in runs:
                raise DataError(
                    f"'{name}' names no single frames: wanted kind/recording[0:64:3, 69, 72]"
                )
            for run in filter(None, runs):
                first = int(run["first"])
                numbers = range(first, int(run["stop"] or first + 1), int(run["step"] or 1))
                frames += [(match["recording"], number) for number in numbers]
        return frames


def read_split_file(name_or_path: str) -> Split:
    """Read a shipped split by its name, or a file.

    Raises:
        DataError: neither a file nor a shipped name, or no split.
    """
    path = Path(name_or_path)
    if not path.is_file():
        wheel, source = config_folders()  # beside the named configurations
        folders = wheel / "splits", source.parent / "splits"
        shipped: dict[str, Path] = {}
        for folder in folders:
            for file in sorted(folder.glob("*.yaml")):
                shipped[file.stem] = file
        if name_or_path not in shipped:
            raise DataError(
                f"no split '{name_or_path}': neither a file nor one of {', '.join(shipped)}"
            )
        path = shipped[name_or_path]
    return read_model(Split, path, DataError, "is no split of train, validation and test")


def usable(recordings: Sequence[Recording], length: int) -> list[Recording]:
    """Recordings that hold at least one snippet of that many frames.

    Raises:
        DataError: none is long enough.
    """
    kept = [r for r in recordings if len(r) >= length]
    if not kept:
        raise DataError(
            f"a snippet needs {length} consecutive frames; found {_lengths(recordings) or 'no recording'}"
        )
    return kept


def split_recordings(
    config: DataConfig, camera: Path | None = None, folder: Path = Path()
) -> tuple[list[Recording], list[Recording]]:
    """Training and validation recordings of all roots.

    They are chosen by the configuration's split, ranges and exclusions; stops are left out.

    Args:
        config: that names the roots.
        camera: the camera file of a user's images and videos, in place of those beside them; ``auto``
            is found by a run.
        folder: keeps what such a run gives.

    Raises:
        DataError: no roots, a name that fits no recording or kind of recordings, a range that begins
            after the end of its recording, or nothing left to train or to validate on.
        ConfigError: a name that is not written like that of a recording or its frames.
    """
    if not config.roots:
        raise DataError("no data to train on: name data sets with --dataset ROOT or data.roots")
    split = read_split_file(config.split) if config.split else Split()
    division = _Division(config, split)
    roots = config.roots
    if camera is not None and is_auto(camera):
        roots, camera = [scene_of(root, camera, folder) for root in roots], None
    found = [each for root in roots for each in discover(root, camera)]
    if camera is not None and not any(each.name.startswith("folder/") for each in found):
        raise DataError(f"--camera {camera} is for images and videos of your own: leave it out")
    division.require_found(found)
    training: list[Recording] = []
    validation: list[Recording] = []
    for recording in found:
        validation += _parts(recording, division.held_out)
        for part in division.chosen(recording):
            training += _rest(part, division.forbidden(recording))
    if not training:
        raise DataError(
            f"nothing left to train on: every recording found ({_lengths(found)}) is excluded or used "
            "to validate or test; see data.exclude, data.validation and data.split"
        )
    if config.validation_share > 0:
        training, ends = _ends_split_off(training, config.validation_share)
        validation += ends
    if not validation:
        _require_none_wanted(config, split, found)
    absent = [name for name in config.validation if not _is_found(FrameRange.parse(name), found)]
    if absent and config.validation != _DEFAULT_VALIDATION:
        logger.warning("data.validation names %s, which is not among the data", _some(absent))
    return _without_stops(training), _without_stops(validation)


class _Division:
    """The frame ranges that a configuration and its split name.

    Attributes:
        ranges: parts that train, of the recordings they name; they come before those of the list.
        listed: recordings or parts that train; without any, all that are found do.
        held_out: what validates, and hence does not train.
        never: what does not train, being excluded or used to test.
        scenes: the same of KITTI raw drives: Eigen's test scenes, where they are excluded.
    """

    def __init__(self, config: DataConfig, split: Split) -> None:
        left_out = read_split_file(EIGEN).test_recordings if EIGEN in config.exclude else []
        self.scenes = _parsed(left_out)
        self.ranges = _parsed(f"{key}[{span}]" for key, span in config.ranges.items())
        self.listed = _parsed(split.train)
        self.held_out = _parsed((*config.validation, *split.validation))
        excluded = [name for name in config.exclude if name != EIGEN]
        self.never = _parsed((*excluded, *split.test_recordings))
        for each in self.never:
            if each.recording.partition("/")[0] not in KINDS:
                raise DataError(
                    f"data.exclude names '{each}', but names of recordings begin with {_some(KINDS)}"
                )

    def require_found(self, found: Sequence[Recording]) -> None:
        """Refuse ranges of recordings that are not there, or that are shorter."""
        for each in self.ranges:
            if not _is_found(each, found):
                raise DataError(
                    f"data.ranges names '{each}', but no recording has that name; "
                    f"found {_lengths(found)}"
                )
        _require_begun(found, [*self.ranges, *self.listed, *self.held_out])

    def chosen(self, recording: Recording) -> list[Recording]:
        """The parts of a recording that train, if nothing forbids it."""
        for named in (self.ranges, self.listed):
            if _spans(recording, named):
                return _parts(recording, named)
        return [] if self.listed else [recording]

    def forbidden(self, recording: Recording) -> list[FrameRange]:
        """What of a recording does not train."""
        scenes = self.scenes if recording.name.startswith("kitti_raw/") else []
        return [*self.held_out, *self.never, *scenes]


def _parsed(names: Iterable[str]) -> list[FrameRange]:
    return list(map(FrameRange.parse, names))


def _is_found(frames: FrameRange, found: Sequence[Recording]) -> bool:
    return any(frames.counted_in(recording.name) is not None for recording in found)


def _require_none_wanted(config: DataConfig, split: Split, found: Sequence[Recording]) -> None:
    """Refuse an empty validation where the configuration or its split name one."""
    is_named = split.validation or config.validation != _DEFAULT_VALIDATION
    if is_named and config.validation:
        wanted = _some([*config.validation, *split.validation])
        raise DataError(
            f"nothing to validate on: data.validation and data.split name {wanted}; found "
            f"{_lengths(found)}; name one of these, or train without validation by data.validation=[]"
        )


def _ends_split_off(
    recordings: list[Recording], share: float
) -> tuple[list[Recording], list[Recording]]:
    """The recordings without their last parts, and these."""
    kept, ends = [], []
    for recording in recordings:
        cut = round((1 - share) * len(recording))
        is_long = len(recording) - cut >= _SHORTEST_END
        kept.append(recording.part(0, cut) if is_long else recording)
        ends += [recording.part(cut, len(recording))] if is_long else []
    if not ends:
        raise DataError(
            f"nothing to validate on: data.validation_share {share:g} leaves fewer than {_SHORTEST_END} frames of "
            f"{_lengths(recordings)}: give longer recordings or a larger share"
        )
    return kept, ends


def _lengths(recordings: Sequence[Recording]) -> str:
    return _some([f"{recording.name} ({len(recording)} frames)" for recording in recordings])


def _some(names: Sequence[str]) -> str:
    """Names for an error: each once, and the first few of many."""
    distinct = list(dict.fromkeys(names))
    return ", ".join(distinct[:8]) + (f" and {len(distinct) - 8} more" if len(distinct) > 8 else "")


def _spans(recording: Recording, ranges: Sequence[FrameRange]) -> list[FrameRange]:
    """Those ranges that are of a recording, by its own numbers."""
    return [span for each in ranges if (span := each.counted_in(recording.name)) is not None]


def _parts(recording: Recording, ranges: Sequence[FrameRange]) -> list[Recording]:
    """The parts of a recording that frame ranges name."""
    parts: list[Recording] = []
    for span in _spans(recording, ranges):
        part = recording.within(span.start, span.stop)
        parts += [] if part is None else [part]
    return parts


def _rest(recording: Recording, ranges: Sequence[FrameRange]) -> list[Recording]:
    """The parts of a recording before, between and after frame ranges."""
    rest = [recording]
    for span in _spans(recording, ranges):
        sides: list[Recording | None] = []
        for part in rest:
            sides += [part.within(0, span.start), part.within(span.stop, EVERYTHING)]
        rest = [side for side in sides if side is not None]
    return rest


def _require_begun(found: Sequence[Recording], ranges: Sequence[FrameRange]) -> None:
    """Refuse frame ranges that begin after the last frame of the recording they name."""
    for each in ranges:
        named = [(r.start + len(r), span) for r in found for span in _spans(r, [each])]
        if named and all(frames.start >= end for end, frames in named):
            end, frames = max(named, key=lambda pair: pair[0])
            raise DataError(f"{frames} begins after the {end} frames that the recording has")


def _moving(recording: Recording) -> list[Recording]:
    """The stretches of an own recording in which the camera moves, every n-th frame where it moves little in one.

    A doubled frame is no stop, and its drive stays whole for the teacher.
    """
    thinned, parts = recording, list[Recording]()
    while not parts and (thinned is recording or len(thinned) > _SHORTEST_STOP):
        shortest = min(_SHORTEST_END, len(thinned))
        found = moving_parts(thinned, _SHORTEST_STOP)
        parts = [part for part in found if len(part) >= shortest]
        thinned = thinned.every(2)
    if parts and (n := parts[0].stride) > 1:
        logger.warning("%s: the camera moves little; every %d-th frame is taken", recording.name, n)
    return parts


def _without_stops(recordings: list[Recording]) -> list[Recording]:
    """The stretches of KITTI raw drives and of own recordings in which the camera moves; others as they are."""
    kept: list[Recording] = []
    for recording in recordings:
        kind, _, _ = recording.name.partition("/")
        if recording.without_stops or kind not in ("kitti_raw", "folder") or recording.exact:
            kept.append(recording)
        elif kind == "kitti_raw":
            kept += moving_parts(recording)
        else:
            kept += _moving(recording)
    before = sum(map(len, recordings))
    if lost := before - sum(map(len, kept)):
        logger.info("left out %d of %d frames in which the camera stands still", lost, before)
    if recordings and not kept:
        raise DataError(
            "the camera stands still in every frame found: nothing can be learned from them; if it moves slowly, "
            "or was recorded at a high rate, give a folder with every n-th image, a tenth of a second apart"
        )
    return kept
