"""Progress bars on the terminal: of the stages before training, and of its steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from lightning.pytorch.callbacks import RichProgressBar
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


class StepBar(RichProgressBar):
    """Lightning's bar on stderr; it counts the steps of the whole run, also after a resume."""

    def __init__(self) -> None:
        super().__init__(refresh_rate=1, leave=True, console_kwargs={"stderr": True})

    @property
    def total_train_batches(self) -> int:
        """All steps: Lightning gives those that are left, and counts from the first."""
        return int(self.trainer.max_steps)
