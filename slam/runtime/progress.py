"""Progress of long work: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

Progress = Callable[[str, int, int], None]
"""Is told the stage of long work, how many of its items are done, and of how many."""

_EVERY_S = 10.0


class ProgressLines:
    """A line every ten seconds of a stage: what is done, how fast, and the time left; none of shorter stages."""

    def __init__(self, write: Callable[[str], object], clock: Callable[[], float] = time.monotonic) -> None:
        self._write, self._clock = write, clock
        self._stage, self._began_s, self._before, self._said_s = "", 0.0, 0, 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Take what is done of a stage."""
        now_s = self._clock()
        if stage != self._stage:
            self._stage, self._began_s, self._before, self._said_s = stage, now_s, done, now_s
        if now_s - self._said_s < _EVERY_S or done <= self._before:
            return
        self._said_s = now_s
        rate = (done - self._before) / (now_s - self._began_s)
        left_s = (total - done) / rate
        self._write(f"{stage}: {done} of {total}, {rate:.2g} a second, {left_s / 60:.0f} min {left_s % 60:.0f} s left")


class progress_bar:  # noqa: N801 - reads as the function it stands for
    """A progress bar for each stage on a terminal, `ProgressLines` on stderr elsewhere."""

    def __enter__(self) -> Progress:
        if sys.stderr is None:
            return lambda stage, done, total: None
        if not sys.stderr.isatty():
            return ProgressLines(lambda line: print(line, file=sys.stderr, flush=True))  # noqa: T201
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            ProgressColumn,
            TextColumn,
            TimeRemainingColumn,
        )
        from rich.text import Text

        class Rate(ProgressColumn):
            def render(self, task: Any) -> Text:
                speed = task.finished_speed or task.speed
                return Text("" if speed is None else f"{speed:.3g} a second")

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Rate(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=Console(stderr=True))
        self._bar.start()
        tasks: dict[str, Any] = {}

        def update(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = self._bar.add_task(stage, total=total)
            self._bar.update(tasks[stage], completed=done)

        return update

    def __exit__(self, *_: object) -> None:
        bar = getattr(self, "_bar", None)
        if bar is not None:
            bar.stop()
