"""A run's libraries compute in the thread that asks, and get their threads back."""

from __future__ import annotations

from threading import Event

import cv2
import pytest
from threadpoolctl import threadpool_info

from slam.runtime.threads import limit_library_threads, read_ahead


def test_threads_are_taken_and_given_back_also_after_an_error() -> None:
    blas = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        with pytest.raises(ZeroDivisionError), limit_library_threads():
            assert cv2.getNumThreads() == 1
            assert all(pool["num_threads"] == 1 for pool in threadpool_info() if pool["user_api"] == "blas")
            _ = 1 / 0
        assert cv2.getNumThreads() == 3
        assert [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"] == blas
    finally:
        cv2.setNumThreads(before)


def test_one_is_read_while_another_is_used() -> None:
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


def test_nothing_and_one_are_read_too() -> None:
    assert list(read_ahead(str, range(3, 3))) == []
    assert list(read_ahead(str, range(3, 4))) == ["3"]


def test_what_cannot_be_read_is_heard_of_in_its_turn() -> None:
    def read(number: int) -> int:
        return 1 // (2 - number)

    numbers = read_ahead(read, range(1, 4))
    assert next(numbers) == 1
    with pytest.raises(ZeroDivisionError):
        next(numbers)
