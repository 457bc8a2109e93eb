"""Atomic writes, with one line of error, and places of files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from erfsfm.common import files
from slam.runtime.errors import SlamError


def write_atomically(
    path: Path,
    content: str | bytes | Callable[[Path], object],
    error: type[SlamError] = SlamError,
    sync: bool = True,
) -> None:
    """`erfsfm.common.files.write_atomically` that raises a `SlamError`.

    Raises:
        SlamError: (or the given kind) the file cannot be written.
    """
    try:
        files.write_atomically(path, content, sync)
    except OSError as cause:
        raise error(str(cause)) from cause


def source_from_anywhere(source: str) -> str:
    """``depth.source`` with its file or folder, where it has one, by the whole path."""
    kind, colon, path = source.partition(":")
    return f"{kind}:{from_anywhere(path)}" if colon else source


def from_anywhere(name_or_path: str | Path) -> str:
    """A file or folder that is there by its whole path, which holds in any folder; all else as it is."""
    path = Path(name_or_path)
    return str(path.absolute() if path.exists() else name_or_path)
