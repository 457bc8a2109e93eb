"""Which recordings and frames a network saw, and whether an evaluation would look at them again.

A name is ``kind/recording`` with an optional half-open frame range: ``kitti_odometry/00[0:250]``,
``kitti_raw/2011_09_26_drive_0013``, ``simulated/17``, ``simulated/0-499``, ``folder/my_drive``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

from erfsfm.errors import ConfigError

# KITTI odometry sequence -> the raw drive it was cut from, its first and one past its last frame there
# (development kit, readme of the odometry benchmark)
ODOMETRY_RAW = {
    "00": ("2011_10_03_drive_0027", 0, 4541),
    "01": ("2011_10_03_drive_0042", 0, 1101),
    "02": ("2011_10_03_drive_0034", 0, 4661),
    "03": ("2011_09_26_drive_0067", 0, 801),
    "04": ("2011_09_30_drive_0016", 0, 271),
    "05": ("2011_09_30_drive_0018", 0, 2761),
    "06": ("2011_09_30_drive_0020", 0, 1101),
    "07": ("2011_09_30_drive_0027", 0, 1101),
    "08": ("2011_09_30_drive_0028", 1100, 5171),
    "09": ("2011_09_30_drive_0033", 0, 1591),
    "10": ("2011_09_30_drive_0034", 0, 1201),
}
_NAME = re.compile(r"^(?P<base>[^\[\]]+?)(?:\[(?P<start>\d*):(?P<stop>\d*)\])?$")
EVERYTHING = 10**9


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
            ConfigError: brackets that hold no range, or an empty one.
        """
        match = _NAME.match(name.strip())
        if match is None:
            raise ConfigError(f"'{name}' names no frames: write kind/recording or kind/recording[start:stop]")
        start = int(match["start"] or 0)
        stop = int(match["stop"] or EVERYTHING)
        if start >= stop:
            raise ConfigError(f"'{name}' names no frames: the range must begin before it ends")
        return FrameRange(match["base"].removesuffix("_sync"), start, stop)

    def counted_in(self, recording: str) -> FrameRange | None:
        """The same frames by the numbers of another recording of the drive; None where that has none of them."""
        if _seed_span_overlaps(self.recording, recording):
            return replace(self, recording=recording)
        drive, first, length = _drive(recording)
        own_drive, own_first, own_length = _drive(self.recording)
        if drive != own_drive:
            return None
        start = max(self.start + own_first - first, 0)
        stop = min(min(self.stop, own_length) + own_first - first, length)
        return FrameRange(recording, start, stop) if start < stop else None

    def covers(self, other: FrameRange) -> bool:
        """Whether the two share a frame."""
        same = self.counted_in(other.recording)
        return same is not None and same.start < other.stop and other.start < same.stop

    def __str__(self) -> str:
        if (self.start, self.stop) == (0, EVERYTHING):
            return self.recording
        return f"{self.recording}[{self.start}:{self.stop if self.stop < EVERYTHING else ''}]"


def overlapping(names: Iterable[str], seen: Iterable[str]) -> list[str]:
    """Those of ``names`` that share frames with what was ``seen``; empty where nothing leaks."""
    ranges = [FrameRange.parse(name) for name in seen]

    def leaks(name: str) -> bool:
        wanted = FrameRange.parse(name)
        return any(wanted.covers(span) for span in ranges)

    return [name for name in names if leaks(name)]


def merge(names: Iterable[str]) -> list[str]:
    """A short, sorted record: neighbouring simulated seeds become spans, doubles vanish."""
    seeds: set[int] = set()
    others: set[str] = set()
    for name in names:
        span = _seed_span(FrameRange.parse(name).recording)
        if span is None:
            others.add(str(FrameRange.parse(name)))
        else:
            seeds |= set(range(span[0], span[1] + 1))
    return _spans(sorted(seeds)) + sorted(others)


def _drive(recording: str) -> tuple[str, int, int]:
    """The drive that a recording was cut from, the number there of its first frame, and how many it has."""
    kind, _, name = recording.partition("/")
    if kind != "kitti_odometry" or name not in ODOMETRY_RAW:
        return recording, 0, EVERYTHING
    drive, first, past_last = ODOMETRY_RAW[name]
    return f"kitti_raw/{drive}", first, past_last - first


def _spans(seeds: list[int]) -> list[str]:
    runs: list[list[int]] = []
    for seed in seeds:
        if runs and runs[-1][-1] + 1 == seed:
            runs[-1].append(seed)
        else:
            runs.append([seed])
    return [f"simulated/{r[0]}" if len(r) == 1 else f"simulated/{r[0]}-{r[-1]}" for r in runs]


def _seed_span(recording: str) -> tuple[int, int] | None:
    match = re.fullmatch(r"simulated/(\d+)(?:-(\d+))?", recording)
    if match is None:
        return None
    return int(match[1]), int(match[2] or match[1])


def _seed_span_overlaps(first: str, second: str) -> bool:
    a, b = _seed_span(first), _seed_span(second)
    return a is not None and b is not None and a[0] <= b[1] and b[0] <= a[1]
