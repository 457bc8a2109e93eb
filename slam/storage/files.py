"""Atomic writes, with one line of error."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from erfsfm import files
from slam.errors import SlamError


def write_atomically(
    path: Path, fill: Callable[[Path], object], error: type[SlamError] = SlamError, sync: bool = True
) -> None:
    """`erfsfm.files.write_atomically` that raises a `SlamError`.

    Raises:
        SlamError: (or the given kind) the file cannot be written.
    """
    try:
        files.write_atomically(path, fill, sync)
    except OSError as cause:
        raise error(str(cause)) from cause
