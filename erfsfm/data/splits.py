"""The leak record: frames a network was trained on, and their overlap with the frames of an evaluation.

Names are those of `erfsfm.common.readers.frame_range`.
"""

from __future__ import annotations

from collections.abc import Iterable

from erfsfm.common.readers.frame_range import FrameRange, seed_span


def overlapping(names: Iterable[str], seen: Iterable[str]) -> list[str]:
    """The ``names`` that share frames with the recordings ``seen``; empty if nothing leaks."""
    ranges = [FrameRange.parse(name) for name in seen]

    def leaks(name: str) -> bool:
        wanted = FrameRange.parse(name)
        return any(wanted.covers(each) for each in ranges)

    return [name for name in names if leaks(name)]


def merge(names: Iterable[str]) -> list[str]:
    """A short, sorted record: neighbouring simulated seeds become ranges, duplicates go."""
    seeds: set[int] = set()
    others: set[str] = set()
    for name in names:
        span = seed_span(FrameRange.parse(name).recording)
        if span is None:
            others.add(str(FrameRange.parse(name)))
        else:
            seeds |= set(range(span[0], span[1] + 1))
    return _seed_ranges(sorted(seeds)) + sorted(others)


def _seed_ranges(seeds: list[int]) -> list[str]:
    runs: list[list[int]] = []
    for seed in seeds:
        if runs and runs[-1][-1] + 1 == seed:
            runs[-1].append(seed)
        else:
            runs.append([seed])
    return [f"simulated/{r[0]}" if len(r) == 1 else f"simulated/{r[0]}-{r[-1]}" for r in runs]
