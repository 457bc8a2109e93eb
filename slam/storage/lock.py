"""Folders that one process at a time writes to."""

from __future__ import annotations

import os
from contextlib import ExitStack, suppress
from pathlib import Path

from slam.errors import RunError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


class FolderLock(ExitStack):
    """Folders held until the end of a block, or of the process, however it ends; nothing is left in them."""

    def take(self, folder: Path) -> None:
        """Hold a folder, which is made; without effect where the file system has no locks, or no folder can be made.

        Raises:
            RunError: another process holds it.
        """
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        if fcntl is None or not folder.is_dir():
            return
        descriptor = os.open(folder, os.O_RDONLY)
        self.callback(os.close, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunError(f"another run writes to {folder}: wait for its end, or choose another --output") from error
        except OSError:
            return
