"""Work in other threads: reading ahead, and items side by side."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

S = TypeVar("S")
T = TypeVar("T")

CORES = 2  # used side by side


def read_ahead(read: Callable[[int], T], numbers: Sequence[int], threads: int = 1) -> Generator[T, None, None]:
    """The result of ``read`` for each number, computed in other ``threads`` while the one before is used.

    They end with the numbers, or when the generator is closed. With more than one, calls must be independent.
    """
    with ThreadPoolExecutor(max_workers=threads, thread_name_prefix="ahead") as ahead:
        waiting: deque[Future[T]] = deque()
        for number in numbers:
            waiting.append(ahead.submit(read, number))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        for last in waiting:
            yield last.result()


def side_by_side(do: Callable[[S], T], items: Iterable[S]) -> list[T]:
    """The result of ``do`` for each item, in order; the calls must be independent."""
    with ThreadPoolExecutor(max_workers=CORES, thread_name_prefix="side") as side:
        return list(side.map(do, items))
