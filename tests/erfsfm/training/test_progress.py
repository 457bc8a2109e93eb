"""The progress bar."""

import io
from types import SimpleNamespace
from typing import Any, cast

import torch
from rich.console import Console

from erfsfm.training.progress import ProgressLine


def test_the_progress_bar_counts_from_the_first_step_of_the_run() -> None:
    written = io.StringIO()
    line = ProgressLine(8, Console(file=written, force_terminal=True, width=120))
    trainer: Any = SimpleNamespace(max_steps=12, global_step=5)
    module = cast(Any, None)
    line.on_train_start(trainer, module)
    for step in range(6, 13):
        trainer.global_step = step
        line.on_train_batch_end(trainer, module, {"loss": torch.tensor(step / 100)}, None, 0)
    line.on_train_end(trainer, module)
    text = written.getvalue()
    assert "5/12" in text and "12/12" in text
    assert "snippets/s" in text and "loss 0.1200" in text and "0:00:00" in text


def test_an_error_ends_the_progress_bar() -> None:
    written = io.StringIO()
    line = ProgressLine(8, Console(file=written, force_terminal=True, width=120))
    trainer: Any = SimpleNamespace(max_steps=12, global_step=0)
    line.on_train_start(trainer, cast(Any, None))
    line.on_exception(trainer, cast(Any, None), RuntimeError())
    assert not line._progress.live.is_started
