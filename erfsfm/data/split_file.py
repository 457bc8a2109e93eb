"""Splits as files: which recordings train, validate and test, each named as in the leak record.

Names are those of `erfsfm.common.readers.frame_range`.

The shipped ones lie in ``configs/splits``. Single frames are written as runs: ``[0:64:3, 69, 72]`` are the frames
0, 3, ..., 63, 69 and 72.
"""

from __future__ import annotations

import re
from pathlib import Path

from pydantic import Field

from erfsfm.common.config_tree import Section, read_model
from erfsfm.common.errors import DataError
from erfsfm.config import config_folders

_FRAMES = re.compile(r"(?P<recording>.+)\[(?P<runs>[\d:, ]+)\]")
_RUN = re.compile(r"(?P<first>\d+)(?::(?P<stop>\d+)(?::(?P<step>[1-9]\d*))?)?")


class Split(Section):
    """A division of recordings; a missing list is empty."""

    train: list[str] = Field(default_factory=list, description="recordings or frame ranges; none: all that are found")
    validation: list[str] = Field(default_factory=list, description="recordings or frame ranges that only validate")
    test: list[str] = Field(default_factory=list, description="recordings or single frames")

    @property
    def test_recordings(self) -> list[str]:
        """Recordings with a frame to test on, without their frames."""
        matches = [(name.strip(), _FRAMES.fullmatch(name.strip())) for name in self.test]
        return [name if match is None else match["recording"] for name, match in matches]

    def test_frames(self) -> list[tuple[str, int]]:
        """Every single frame to test on: its recording and number."""
        return [frame for name in self.test for frame in _frames(name)]


def read_split_file(name_or_path: str) -> Split:
    """Read a shipped split by its name, or a file."""
    path = Path(name_or_path)
    if not path.is_file():
        wheel, source = config_folders()  # beside the named configurations
        folders = wheel / "splits", source.parent / "splits"
        shipped = {file.stem: file for folder in folders for file in sorted(folder.glob("*.yaml"))}
        if name_or_path not in shipped:
            raise DataError(f"no split '{name_or_path}': neither a file nor one of {', '.join(shipped)}")
        path = shipped[name_or_path]
    return read_model(Split, path, DataError, "is no split of train, validation and test")


def _frames(name: str) -> list[tuple[str, int]]:
    match = _FRAMES.fullmatch(name.strip())
    runs = [_RUN.fullmatch(text.strip()) for text in match["runs"].split(",")] if match else []
    if match is None or None in runs:
        raise DataError(f"'{name}' names no single frames: wanted kind/recording[0:64:3, 69, 72]")
    numbers: list[int] = []
    for run in filter(None, runs):
        first = int(run["first"])
        numbers += range(first, int(run["stop"] or first + 1), int(run["step"] or 1))
    return [(match["recording"], number) for number in numbers]
