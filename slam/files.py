"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from slam.errors import SlamError


def write_atomically(path: Path, fill: Callable[[Path], object], error: type[SlamError] = SlamError) -> None:
    """Let ``fill`` write a file beside ``path``, then move it into place; missing parent folders are made.

    The temporary name ends as ``path`` does, for writers that look at the suffix.

    Raises:
        SlamError: (or the given kind) the file cannot be written.
    """
    partial = path.with_name(f".{os.getpid()}.partial.{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fill(partial)
        partial.replace(path)
    except OSError as cause:
        raise error(f"{path}: cannot be written ({cause.strerror or cause})") from cause
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
