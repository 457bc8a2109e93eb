"""Memory that is asked for before it is needed, by libraries that cannot do without; standard library alone."""

from __future__ import annotations

import mmap


def require_memory(size: int) -> None:
    """Check that ``size`` bytes can be had now.

    Raises:
        MemoryError: there is not enough.
    """
    try:
        mmap.mmap(-1, size).close()
    except OSError as error:
        raise MemoryError from error
