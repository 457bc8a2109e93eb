"""Work in other threads: reading ahead, and items side by side."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

S = TypeVar("S")
T = TypeVar("T")

_CORES = 2


def read_ahead(read: Callable[[int], T], numbers: Sequence[int]) -> Generator[T, None, None]:
    """The result of ``read`` for each number, computed in another thread while the one before is used.

    The thread ends with the numbers, or when the generator is closed.
    """
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="ahead") as ahead:
        waiting: deque[Future[T]] = deque()
        for number in numbers:
            waiting.append(ahead.submit(read, number))
            if len(waiting) > 1:
                yield waiting.popleft().result()
        for last in waiting:
            yield last.result()


def side_by_side(do: Callable[[S], T], items: Iterable[S]) -> list[T]:
    """The result of ``do`` for each item, in order; the calls must be independent."""
    with ThreadPoolExecutor(max_workers=_CORES, thread_name_prefix="side") as side:
        return list(side.map(do, items))
