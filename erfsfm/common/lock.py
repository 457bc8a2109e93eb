"""Folders that one process at a time writes to."""

from __future__ import annotations

import fcntl
import os
from contextlib import ExitStack, suppress
from pathlib import Path

from erfsfm.common.errors import BusyError


class FolderLock(ExitStack):
    """Folders held until the end of a block, or of the process, however it ends; nothing is left in them."""

    def take(self, folder: Path) -> None:
        """Hold a folder, which is made; without effect where the file system has no locks, or no folder can be made.

        Raises:
            BusyError: another process holds it.
        """
        try:
            self._lock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BusyError(
                f"another process writes to {folder}: wait for its end, or choose another --output"
            ) from error

    def wait_for(self, folder: Path) -> None:
        """Hold a folder as soon as no other process does; else as `take`."""
        self._lock(folder, fcntl.LOCK_EX)

    def _lock(self, folder: Path, how: int) -> None:
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        if not folder.is_dir():
            return
        descriptor = os.open(folder, os.O_RDONLY)
        self.callback(os.close, descriptor)
        try:
            fcntl.flock(descriptor, how)
        except BlockingIOError:
            raise
        except OSError:  # no locks here
            return
