"""The file that a command writes: what it may replace, an empty file or one of the same kind, and none of a run."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from slam.formats.trajectory import read_trajectory
from slam.runtime.errors import RunError, TrajectoryError
from slam.runtime.run_files import ESTIMATE, MEANINGS, METRICS

_TRAJECTORIES = (".txt", ".tum", ".kitti")


def check_replaced(path: Path, beginnings: Mapping[str, bytes]) -> None:
    """Check what a file would replace.

    Args:
        path: the file to write.
        beginnings: ends of the names that it may have, and how such files begin.

    Raises:
        RunError: a folder, a file of a run, one with another end of its name, or one that does not begin so.
    """
    if _must_be_known(path, beginnings):
        with path.open("rb") as file:
            if not file.read(64).startswith(beginnings[path.suffix.lower()]):
                raise _of_another_kind(path)


def check_replaced_trajectory(path: Path) -> None:
    """As `check_replaced`, for a trajectory, which may replace any trajectory.

    Raises:
        RunError: as there.
    """
    if _must_be_known(path, _TRAJECTORIES):
        try:
            read_trajectory(path)
        except TrajectoryError as error:
            raise _of_another_kind(path) from error


def _must_be_known(path: Path, suffixes: Collection[str]) -> bool:
    """Whether there is a file whose content must be looked at."""
    if path.is_dir():
        raise RunError(f"{path} is a folder: give the name of a file to write")
    if path.name in MEANINGS and any((path.parent / name).is_file() for name in (METRICS, ESTIMATE)):
        raise RunError(f"{path} is a file of a run: choose another --output")
    if not path.is_file() or not path.stat().st_size:
        return False
    if path.suffix.lower() not in suffixes:
        raise RunError(f"{path} exists and does not end in {' or '.join(suffixes)}: choose another --output")
    return True


def _of_another_kind(path: Path) -> RunError:
    return RunError(f"{path} exists and is a file of another kind than is written: choose another --output")
