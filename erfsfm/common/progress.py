"""Progress of long work: bars on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

Progress = Callable[[str, int, int], None]
"""Is told the stage of long work, how many of its items are done, and of how many; what follows a comma may change."""


def silent(stage: str, done: int, total: int) -> None:
    """Progress that nobody is told."""


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A bar for each stage on a terminal; elsewhere `progress_lines` on stderr."""
    if sys.stderr is None:
        yield silent
    elif sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bars

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        tasks: dict[str, Any] = {}
        with Bars(*columns, console=Console(stderr=True)) as bars:

            def update(stage: str, done: int, total: int) -> None:
                name = _name(stage)
                if name not in tasks:
                    tasks[name] = bars.add_task(stage, total=total)
                bars.update(tasks[name], completed=done, total=total, description=stage)

            yield update
    else:
        with progress_lines(lambda line: sys.stderr.write(f"{line}\n")) as lines:
            yield lines


@contextmanager
def progress_lines(write: Callable[[str], object], every_s: float = 10.0) -> Iterator[Progress]:
    """A line every ten seconds: the stage, what is done, and the time left at the rate of the stage."""
    began = said = time.monotonic()
    name, before = "", 0

    def update(stage: str, done: int, total: int) -> None:
        nonlocal began, said, name, before
        now = time.monotonic()
        if _name(stage) != name:
            name, began, before = _name(stage), now, done
        if now - said < every_s:
            return
        said, left = now, ""
        if done > before:
            left = f", {duration((total - done) * (now - began) / (done - before))} left"
        write(f"{stage}: {done} of {total}{left}")

    yield update


def duration(seconds: float) -> str:
    """A time in words, to two units at most."""
    minutes, hours = round(seconds) // 60, round(seconds) // 3600
    if hours >= 48:
        return f"{hours / 24:.1f} days"
    return (
        f"{hours} h {minutes % 60} min" if hours >= 2 else f"{minutes} min {round(seconds) % 60} s"
    )


def _name(stage: str) -> str:
    return stage.partition(",")[0]
