"""SIGTERM and SIGHUP as exceptions, so that a terminated run can record its reason."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

_ENDS = (signal.SIGTERM, signal.SIGHUP)


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
    before = _handlers((signal.SIGINT, *_ENDS), lambda handler: handler is not signal.SIG_IGN)

    def first(*_: object) -> None:
        _handle(
            dict.fromkeys(before, signal.SIG_IGN)
            | {n: before[n] for n in before if n == signal.SIGINT}
        )
        stop()

    _handle(dict.fromkeys(before, first))
    try:
        yield
    finally:
        _handle(before)


@contextmanager
def raising_on_termination() -> Iterator[Callable[[], None]]:
    """Raise `Terminated` in the block at a signal to terminate.

    Only in the main thread, and only for signals that are not handled or ignored already.

    Yields:
        A function that ignores these signals for the rest of the block: ``timeout`` and shells send the same one
        several times, and the files written after the first one must become whole.
    """
    before = _handlers(_ENDS, lambda handler: handler is signal.SIG_DFL)

    def ignore() -> None:
        _handle(dict.fromkeys(before, signal.SIG_IGN))

    def end(number: int, _: object) -> None:
        ignore()
        raise Terminated(number)

    _handle(dict.fromkeys(before, end))
    try:
        yield ignore
    finally:
        _handle(before)


def _handlers(numbers: Sequence[int], is_replaced: Callable[[Any], bool]) -> dict[int, Any]:
    """Handlers that may be replaced, by signal; none outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    handlers = {number: signal.getsignal(number) for number in numbers}
    return {number: handler for number, handler in handlers.items() if is_replaced(handler)}


def _handle(handlers: Mapping[int, Any]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)
