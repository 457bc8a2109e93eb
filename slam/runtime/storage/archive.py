"""Archives (zip, npz) that may be damaged: every failure of reading is one `RunError`."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.runtime.errors import RunError, SlamError


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
    """An archive to read, as in `reading_archive`."""
    with reading_archive(path), zipfile.ZipFile(path) as file:
        yield file


def read_array(file: zipfile.ZipFile, name: str) -> NDArray[Any]:
    """An array of an ``.npz``."""
    with file.open(f"{name}.npy") as content:
        array: NDArray[Any] = np.lib.format.read_array(content, allow_pickle=False)
        return array
