"""Archives (zip, npz) that may be damaged: every failure of reading is one `RunError`, and memory is bounded."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from slam.runtime.errors import RunError, SlamError

# a deflated stream grows by up to a thousand times, arrays of measurements by less than ten
_LARGEST_GROWTH = 100
_FREE_BYTES = 2**26


@contextmanager
def reading_archive(path: Path) -> Iterator[None]:
    """Turn any failure inside the block into one line about ``path``; a `SlamError` is passed on.

    Raises:
        RunError: the file is missing, unreadable or damaged.
    """
    try:
        yield
    except SlamError:
        raise
    except FileNotFoundError as error:
        raise RunError(f"{path} is missing: run the sequence again") from error
    except MemoryError as error:
        raise RunError(f"{path} needs more memory than there is, or is damaged: free some, or run again") from error
    # Damaged bytes raise almost anything in zipfile, zlib, json, tokenize and NumPy: no list of types is complete.
    except Exception as error:
        reason = " ".join(str(error).split())[:120]
        detail = f"{type(error).__name__}: {reason}" if reason else type(error).__name__
        raise RunError(f"{path} is damaged ({detail}): run the sequence again") from error


@contextmanager
def opened_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """An archive to read, as in `reading_archive`; one that announces far more than it can hold is damaged."""
    with reading_archive(path), zipfile.ZipFile(path) as file:
        announced = sum(member.file_size for member in file.infolist())
        if announced > _FREE_BYTES + _LARGEST_GROWTH * path.stat().st_size:
            raise RunError(f"{path} is damaged (it announces {announced} bytes): run the sequence again")
        yield file


def read_array(file: zipfile.ZipFile, name: str) -> NDArray[Any]:
    """An array of an ``.npz``, whose shape is checked against the size of its member before it is made."""
    member = file.getinfo(f"{name}.npy")
    with file.open(member) as content:
        size = _announced_bytes(content)
        if size != member.file_size:
            raise ValueError(f"array {name} announces {size} bytes and has {member.file_size}")
    with file.open(member) as content:
        array: NDArray[Any] = np.lib.format.read_array(content, allow_pickle=False)
        return array


def _announced_bytes(content: IO[bytes]) -> int:
    """Size of an ``.npy`` file by its header."""
    version = np.lib.format.read_magic(content)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(content)
    return int(content.tell() + dtype.itemsize * math.prod(shape))
