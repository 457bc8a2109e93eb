"""Libraries compute in the calling thread, and their thread counts are restored."""

from __future__ import annotations

import os
import subprocess
import sys
from threading import Barrier, Event

import cv2
import pytest
from threadpoolctl import threadpool_info

from erfsfm.common.processes import limit_library_threads, read_ahead


def test_thread_counts_are_limited_and_restored_also_after_an_error():
    blas = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        with pytest.raises(ZeroDivisionError), limit_library_threads():
            assert cv2.getNumThreads() == 1
            assert all(
                pool["num_threads"] == 1 for pool in threadpool_info() if pool["user_api"] == "blas"
            )
            _ = 1 / 0
        assert cv2.getNumThreads() == 3
        assert [
            pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"
        ] == blas
    finally:
        cv2.setNumThreads(before)


def test_one_process_of_many_starts_no_threads():
    program = (
        "import cv2, numpy\n"
        "from threadpoolctl import threadpool_info\n"
        "from erfsfm.common.processes import stay_single_threaded, usable_cores\n"
        "cv2.setNumThreads(3)\n"
        "stay_single_threaded()\n"
        "counts = [pool['num_threads'] for pool in threadpool_info()]\n"
        "assert {*counts, cv2.getNumThreads(), usable_cores()} == {1}, counts\n"  # as PyTorch, too, counts them
    )
    threads = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    free = {name: value for name, value in os.environ.items() if name not in threads}
    done = subprocess.run(
        [sys.executable, "-c", program], env=free, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_one_is_read_while_another_is_used():
    begun: list[int] = []
    second = Event()

    def read(number: int) -> int:
        begun.append(number)
        if number == 5:
            second.set()
        return 10 * number

    numbers = read_ahead(read, range(4, 8))
    assert next(numbers) == 40
    assert second.wait(10.0) and 6 not in begun
    assert list(numbers) == [50, 60, 70] and begun == [4, 5, 6, 7]


def test_two_threads_read_at_once_and_in_order():
    both = Barrier(2)

    def read(number: int) -> int:
        both.wait(10.0)
        return number

    assert list(read_ahead(read, range(6), threads=2)) == [0, 1, 2, 3, 4, 5]
