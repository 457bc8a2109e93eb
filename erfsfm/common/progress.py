"""Progress of long work: bars on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Any

Progress = Callable[[str, int, int], None]
"""Is told the stage of long work, how many of its items are done, and of how many; what follows a comma may change."""

_EVERY_S = 10.0


def silent(stage: str, done: int, total: int) -> None:
    """Progress that nobody is told."""


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A bar for each stage on a terminal; elsewhere `progress_lines` on stderr."""
    if sys.stderr is None:
        yield silent
    elif sys.stderr.isatty():
        with _bars() as update:
            yield update
    else:
        with progress_lines(lambda line: sys.stderr.write(f"{line}\n")) as update:
            yield update


@contextmanager
def progress_lines(write: Callable[[str], object], every_s: float = _EVERY_S) -> Iterator[Progress]:
    """A line every ten seconds, also while one item takes longer: the stage, what is done, its rate, the time left."""
    lines, over = _Lines(), Event()

    def speak() -> None:
        while not over.wait(every_s):
            if lines.stage:
                write(lines.text(time.monotonic()))

    thread = Thread(target=speak, name="progress", daemon=True)
    thread.start()
    try:
        yield lambda stage, done, total: lines.take(stage, done, total, time.monotonic())
    finally:
        over.set()
        thread.join()


def duration(seconds: int) -> str:
    """A time in words, to two units at most."""
    minutes, hours = seconds // 60, seconds // 3600
    if hours >= 48:
        return f"{hours / 24:.1f} days"
    return f"{hours} h {minutes % 60} min" if hours >= 2 else f"{minutes} min {seconds % 60} s"


class _Lines:
    def __init__(self) -> None:
        self.stage = ""
        self._done = self._total = self._before = 0
        self._began_s = 0.0

    def take(self, stage: str, done: int, total: int, now_s: float) -> None:
        if _name(stage) != _name(self.stage):
            self._before, self._began_s = done, now_s
        self.stage, self._done, self._total = stage, done, total

    def text(self, now_s: float) -> str:
        spent_s, done = now_s - self._began_s, self._done - self._before
        text = f"{self.stage}: {self._done} of {self._total}"
        if done <= 0 or spent_s <= 0 or self._done >= self._total:
            return f"{text} after {spent_s:.0f} s"
        left_s = round((self._total - self._done) * spent_s / done)
        return f"{text}, {done / spent_s:.2g} a second, {duration(left_s)} left"


@contextmanager
def _bars() -> Iterator[Progress]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: Any) -> Text:
            speed = task.finished_speed or task.speed
            return Text("" if speed is None else f"{speed:.3g} a second")

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Rate(), TimeRemainingColumn())
    tasks: dict[str, Any] = {}
    with Bars(*columns, console=Console(stderr=True)) as bars:

        def update(stage: str, done: int, total: int) -> None:
            name = _name(stage)
            if name not in tasks:
                tasks[name] = bars.add_task(stage, total=total)
            bars.update(tasks[name], completed=done, description=stage)

        yield update


def _name(stage: str) -> str:
    return stage.partition(",")[0]
