"""SIGTERM and SIGHUP as exceptions, so that a terminated run can record its reason."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_NAMES = ("SIGTERM", "SIGHUP")  # Windows has no SIGHUP


class Terminated(SystemExit):
    """The process was terminated by a signal; the exit code is 128 plus the signal's number."""

    def __init__(self, number: int, place: str = "") -> None:
        super().__init__(128 + number)
        self.number, self.place = number, place

    def __str__(self) -> str:
        return f"ended by {signal.Signals(self.number).name}{self.place}"


@contextmanager
def calling_on_signals(stop: Callable[..., None]) -> Iterator[None]:
    """Call ``stop`` at the first ctrl-C, SIGTERM or SIGHUP in the block; after it a second ctrl-C counts as before.

    Only in the main thread, and only for signals that are not ignored already.
    """
    handlers: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        numbers = [getattr(signal, name) for name in ("SIGINT", *_NAMES) if hasattr(signal, name)]
        handlers = {n: before for n in numbers if (before := signal.getsignal(n)) is not signal.SIG_IGN}

    def first(*_: object) -> None:
        for number in handlers:
            signal.signal(number, handlers[number] if number == signal.SIGINT else signal.SIG_IGN)
        stop()

    for number in handlers:
        signal.signal(number, first)
    try:
        yield
    finally:
        for number, before in handlers.items():
            signal.signal(number, before)


@contextmanager
def raising_on_termination() -> Iterator[Callable[[], None]]:
    """Raise `Terminated` in the block at a signal to terminate.

    Only in the main thread, and only for signals that are not handled or ignored already.

    Yields:
        A function that ignores these signals for the rest of the block: ``timeout`` and shells send the same one
        several times, and the files written after the first one must become whole.
    """
    numbers: list[int] = []
    if threading.current_thread() is threading.main_thread():
        known = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
        numbers = [number for number in known if signal.getsignal(number) is signal.SIG_DFL]

    def end(number: int, _: object) -> None:
        ignore()
        raise Terminated(number)

    def ignore() -> None:
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)

    for number in numbers:
        signal.signal(number, end)
    try:
        yield ignore
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)
