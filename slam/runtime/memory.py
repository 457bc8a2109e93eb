"""Memory of the process: its peak, and what is given back."""

from __future__ import annotations

import ctypes
import resource
import sys


def peak_rss_mb() -> float:
    """Largest resident memory of this process so far, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def return_freed_memory() -> None:
    """Give memory back that glibc's heaps keep: of images and layers of many sizes about 120 kB a frame."""
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)
