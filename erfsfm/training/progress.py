"""What the steps of a training say of themselves."""

from __future__ import annotations

from typing import Any

import lightning
from lightning.pytorch.callbacks import Callback

from erfsfm.common.progress import Progress


class StepProgress(Callback):
    """Tells of the steps of the whole run, also after a resume, and of the loss of the latest."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Tell of a step; reading the loss waits for the device."""
        loss = float(trainer.callback_metrics["loss"])
        self._progress(f"steps, loss {loss:.4g}", trainer.global_step, trainer.max_steps)
