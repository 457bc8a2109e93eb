"""Spilled arrays are read back unchanged, and a file cut short is one clear error."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from slam.runtime.errors import SlamError
from slam.runtime.memory import SpillFile


def test_arrays_come_back_in_any_order():
    rng = np.random.default_rng(0)
    arrays = [
        rng.integers(0, 255, (4, 5, 3), np.uint8),
        rng.normal(size=(4, 5)).astype(np.float32)[:, ::2],
        np.eye(4),
    ]
    spill_file = SpillFile()
    kept = [spill_file.put(array) for array in arrays]
    kept[0]()
    kept.append(spill_file.put(arrays[0]))
    for array, each in reversed(list(zip([*arrays, arrays[0]], kept, strict=True))):
        np.testing.assert_array_equal(each(), array)
        assert each().dtype == array.dtype


def test_threads_read_while_others_write():
    spill_file = SpillFile()

    def write_and_read(number: int) -> bool:
        kept = [spill_file.put(np.full(2000, 1000 * number + k)) for k in range(50)]
        return all((each() == 1000 * number + k).all() for k, each in enumerate(kept))

    with ThreadPoolExecutor(4) as threads:
        assert all(threads.map(write_and_read, range(40)))


def test_a_file_that_was_cut_short_is_an_error_and_no_garbage():
    spill_file = SpillFile()
    kept = spill_file.put(np.ones((100, 100)))
    spill_file._file.truncate(5000)
    with pytest.raises(SlamError, match=r"cannot be read .*: run again"):
        kept()
