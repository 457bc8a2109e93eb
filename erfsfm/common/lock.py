"""Folders that one process at a time writes to."""

from __future__ import annotations

import os
from contextlib import ExitStack, suppress
from pathlib import Path

from erfsfm.common.errors import BusyError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_held: set[int] = set()


class FolderLock(ExitStack):
    """Folders held until the end of a block, or of the process, however it ends; nothing is left in them."""

    def take(self, folder: Path) -> None:
        """Hold a folder, which is made; without effect where the file system has no locks, or no folder can be made.

        Raises:
            BusyError: another process holds it.
        """
        if not self._lock(folder, at_once=True):
            raise BusyError(f"another process writes to {folder}: wait for its end, or choose another --output")

    def wait_for(self, folder: Path) -> None:
        """Hold a folder as soon as no other process does; else as `take`."""
        self._lock(folder, at_once=False)

    def _lock(self, folder: Path, at_once: bool) -> bool:
        """Whether no other process holds it, as far as the file system knows."""
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        if fcntl is None or not folder.is_dir():
            return True
        descriptor = os.open(folder, os.O_RDONLY)
        _held.add(descriptor)
        self.callback(_release, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (fcntl.LOCK_NB if at_once else 0))
        except OSError as error:
            return not isinstance(error, BlockingIOError)
        return True


def _release(descriptor: int) -> None:
    _held.discard(descriptor)
    os.close(descriptor)


def _leave_to_parent() -> None:
    """A process that was forked, and may live longer, holds nothing."""
    for descriptor in tuple(_held):
        _release(descriptor)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)
