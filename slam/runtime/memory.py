"""Freed memory, which glibc's heaps keep: of images and network layers of many sizes about 120 kB a frame."""

from __future__ import annotations

import ctypes
import sys


def return_freed_memory() -> None:
    """Give freed memory back to the system; where the C library is not glibc, that is left to the library."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
