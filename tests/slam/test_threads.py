"""A run's libraries compute in the thread that asks, and get their threads back."""

from __future__ import annotations

import cv2
import pytest
from threadpoolctl import threadpool_info

from slam.threads import one_thread_each


def test_threads_are_taken_and_given_back_also_after_an_error() -> None:
    blas = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        with pytest.raises(ZeroDivisionError), one_thread_each():
            assert cv2.getNumThreads() == 1
            assert all(pool["num_threads"] == 1 for pool in threadpool_info() if pool["user_api"] == "blas")
            _ = 1 / 0
        assert cv2.getNumThreads() == 3
        assert [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"] == blas
    finally:
        cv2.setNumThreads(before)
