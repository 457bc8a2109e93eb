"""Work in other threads: reading ahead, items side by side, and calls in turn."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import wraps
from threading import RLock
from typing import Concatenate, ParamSpec, Protocol, TypeVar, cast

from slam.runtime.errors import SlamError

S = TypeVar("S")
T = TypeVar("T")
P = ParamSpec("P")

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


class Turns:
    """The lock of an object whose threads a forked process has not."""

    def __init__(self) -> None:
        """Of an object in this process."""
        self.lock, self._process = RLock(), os.getpid()

    def require_own_process(self) -> None:
        """Raise in a forked process, where a call would wait for ever."""
        if os.getpid() != self._process:
            raise SlamError(
                "this session is of the process that made it, whose threads a forked one has not: make Slam "
                "there, or start processes with multiprocessing.get_context('spawn')"
            )


class _HasTurns(Protocol):
    _turns: Turns


Owner = TypeVar("Owner", bound=_HasTurns)


def in_turn(method: Callable[Concatenate[Owner, P], T]) -> Callable[Concatenate[Owner, P], T]:
    """A method that threads call one after the other."""

    @wraps(method)
    def locked(self: Owner, *args: P.args, **kwargs: P.kwargs) -> T:
        self._turns.require_own_process()
        with self._turns.lock:
            return method(self, *args, **kwargs)

    return cast("Callable[Concatenate[Owner, P], T]", locked)
