"""Names of recordings and their frames, as the leak record of a checkpoint writes them.

A name is ``kind/recording`` with an optional half-open frame range: ``kitti_odometry/00[0:250]``,
``kitti_raw/2011_09_26_drive_0013``, ``simulated/17``, ``simulated/0-499``, ``folder/my_drive``, ``folder/clips/clip2``.
The range is read from the right: a folder may have brackets in its own name.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

from erfsfm.common.errors import ConfigError
from erfsfm.common.readers.kitti import ODOMETRY_DRIVES

EVERYTHING = 10**9
KINDS = ("folder", "kitti_odometry", "kitti_raw", "simulated")
_RANGED = re.compile(r"(?P<base>.+)\[(?P<start>\d*):(?P<stop>\d*)\]", re.DOTALL)
_PLAIN = re.compile(
    r"[^\[\]]+|(?!kitti_|simulated/)\w+/.+", re.DOTALL
)  # users name their own folders as they like


@dataclass(frozen=True)
class FrameRange:
    """Frames ``start`` to ``stop - 1`` of a recording, by its own numbers."""

    recording: str
    start: int
    stop: int

    @staticmethod
    def parse(name: str) -> FrameRange:
        """Read a name; raw drives lose their ``_sync``.

        Raises:
            ConfigError: it names no frames.
        """
        name = name.strip()
        match = _RANGED.fullmatch(name)
        if match is None:
            if not _PLAIN.fullmatch(name):
                raise ConfigError(
                    f"'{name}' names no frames: write kind/recording or kind/recording[start:stop]"
                )
            return FrameRange(name.removesuffix("_sync"), 0, EVERYTHING)
        start = int(match["start"] or 0)
        stop = int(match["stop"] or EVERYTHING)
        if start >= stop:
            raise ConfigError(f"'{name}' names no frames: the range must begin before it ends")
        return FrameRange(match["base"].removesuffix("_sync"), start, stop)

    def counted_in(self, recording: str) -> FrameRange | None:
        """The same frames by the numbers of another recording of the drive; None where that has none of them."""
        a, b = seed_span(self.recording), seed_span(recording)
        if a is not None and b is not None and a[0] <= b[1] and b[0] <= a[1]:
            return replace(self, recording=recording)
        drive, first, length = _drive(recording)
        own_drive, own_first, own_length = _drive(self.recording)
        if drive != own_drive:
            return None
        start = max(self.start + own_first - first, 0)
        stop = min(min(self.stop, own_length) + own_first - first, length)
        return FrameRange(recording, start, stop) if start < stop else None

    def covers(self, other: FrameRange) -> bool:
        """Whether the two share a frame; the name of a folder stands for any video in it."""
        shorter, longer = sorted((self.recording, other.recording), key=len)
        same = self if longer.startswith(f"{shorter}/") else self.counted_in(other.recording)
        return same is not None and same.start < other.stop and other.start < same.stop

    def __str__(self) -> str:
        if (self.start, self.stop) == (0, EVERYTHING) and "[" not in self.recording:
            return self.recording
        return f"{self.recording}[{self.start}:{self.stop if self.stop < EVERYTHING else ''}]"


def overlapping(names: Iterable[str], seen: Iterable[str]) -> list[str]:
    """Those of ``names`` that share frames with what was ``seen`` in training; empty where nothing leaks."""
    ranges = list(map(FrameRange.parse, seen))
    found = []
    for name in names:
        frames = FrameRange.parse(name)
        if any(map(frames.covers, ranges)):
            found.append(name)
    return found


def runs(frames: Collection[int]) -> list[tuple[int, int]]:
    """Unbroken runs of frame numbers as (first, last)."""
    known = set(frames)
    firsts = [k for k in known if k - 1 not in known]
    lasts = [k for k in known if k + 1 not in known]
    return list(zip(sorted(firsts), sorted(lasts)))


def merge(names: Iterable[str]) -> list[str]:
    """A short, sorted leak record: neighbouring simulated seeds become ranges, duplicates go."""
    seeds: set[int] = set()
    others: set[str] = set()
    for name in names:
        span = seed_span(FrameRange.parse(name).recording)
        if span is None:
            others.add(str(FrameRange.parse(name)))
        else:
            seeds |= set(range(span[0], span[1] + 1))
    ranges = [f"simulated/{a}" if a == b else f"simulated/{a}-{b}" for a, b in runs(seeds)]
    return ranges + sorted(others)


def seed_span(recording: str) -> tuple[int, int] | None:
    """The first and last seed of simulated worlds; None of any other recording."""
    match = re.fullmatch(r"simulated/(\d+)(?:-(\d+))?", recording)
    if match is None:
        return None
    return int(match[1]), int(match[2] or match[1])


def _drive(recording: str) -> tuple[str, int, int]:
    """The drive that a recording was cut from, the number there of its first frame, and how many it has."""
    kind, _, name = recording.partition("/")
    if kind != "kitti_odometry" or name not in ODOMETRY_DRIVES:
        return recording, 0, EVERYTHING
    drive, first, past_last = ODOMETRY_DRIVES[name]
    return f"kitti_raw/{drive}", first, past_last - first
