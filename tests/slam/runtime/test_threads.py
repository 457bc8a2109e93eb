"""Reading ahead in another thread."""

from __future__ import annotations

from threading import Barrier, Event

from slam.runtime.threads import read_ahead


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


def test_two_threads_read_at_once_and_in_order() -> None:
    both = Barrier(2)

    def read(number: int) -> int:
        both.wait(10.0)
        return number

    assert list(read_ahead(read, range(6), threads=2)) == [0, 1, 2, 3, 4, 5]
