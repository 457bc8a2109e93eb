"""Atomic writes, with one line of error, and places of files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from erfsfm.common import files
from slam.runtime.errors import SlamError


def write_atomically(
    path: Path, fill: Callable[[Path], object], error: type[SlamError] = SlamError, sync: bool = True
) -> None:
    """`erfsfm.common.files.write_atomically` that raises a `SlamError`.

    Raises:
        SlamError: (or the given kind) the file cannot be written.
    """
    try:
        files.write_atomically(path, fill, sync)
    except OSError as cause:
        raise error(str(cause)) from cause


def from_anywhere(name_or_path: str | Path) -> str:
    """A file or folder that is there by its whole path, which holds in any folder; all else as it is."""
    path = Path(name_or_path)
    return str(path.absolute() if path.exists() else name_or_path)
