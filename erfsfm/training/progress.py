"""Progress bars on the terminal: of the stages before training, and of its steps, speed, time left and loss."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import lightning
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn


@contextmanager
def stage_bars(quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """One bar a stage on stderr, each by its name, what is done and the total; none where ``quiet``."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet) as bars:
        tasks: dict[str, TaskID] = {}

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done)

        yield show


class ProgressLine(Callback):
    """Snippets a second and time left over the whole run, on stderr."""

    def __init__(self, snippets_a_step: int, console: Console | None = None) -> None:
        self._snippets = snippets_a_step
        self._progress = Progress(
            TextColumn("training"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[speed]} loss {task.fields[loss]}"),
            console=console or Console(stderr=True),
        )

    def on_train_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Begin at the first step of the run, which after a resume is not zero."""
        self._task = self._progress.add_task(
            "", total=trainer.max_steps, completed=trainer.global_step, speed="", loss="-"
        )
        self._progress.start()

    def on_train_batch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Advance by one step."""
        speed = self._progress.tasks[self._task].speed
        self._progress.update(
            self._task,
            completed=trainer.global_step,
            speed=f"{speed * self._snippets:.1f} snippets/s" if speed else "",
            loss=f"{float(outputs['loss']):.4f}",
        )

    def on_train_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Leave the line as it is."""
        self._progress.stop()

    def on_exception(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, exception: BaseException
    ) -> None:
        """Leave the line, so that the error is printed below it."""
        self._progress.stop()
