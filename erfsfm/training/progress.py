"""What the steps of a training say of themselves."""

from __future__ import annotations

import logging
import time
from typing import Any

import lightning
from lightning.pytorch.callbacks import Callback

from erfsfm.common.progress import Progress, duration
from erfsfm.training.module import SelfSupervision

logger = logging.getLogger(__name__)

_TIMED_STEPS, _TIMED_S = 20, 30.0  # whichever comes first


class StepProgress(Callback):
    """Tells of all steps, also after a resume, and of the loss of the latest; logs what a step takes."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._began: tuple[int, float] | None = None
        self._said = False

    def on_train_start(self, trainer: lightning.Trainer, *_: Any) -> None:
        """Tell that the steps begin."""
        if trainer.is_global_zero:
            self._progress("steps", trainer.global_step, trainer.max_steps)

    def on_train_batch_end(self, trainer: lightning.Trainer, module: lightning.LightningModule, *_: Any) -> None:
        """Tell of a step."""
        assert isinstance(module, SelfSupervision)
        if not trainer.is_global_zero:
            return
        step, steps, now_s = trainer.global_step, trainer.max_steps, time.monotonic()
        first, began_s = self._began = self._began or (step, now_s)
        timed = step - first >= min(_TIMED_STEPS, steps - first) or now_s - began_s >= _TIMED_S
        if timed and step > first and not self._said:
            self._said = True
            took_s = (now_s - began_s) / (step - first)
            logger.info("a step takes %.2g s, all %d steps take %s", took_s, steps, duration(round(steps * took_s)))
        self._progress(f"steps, loss {module.loss:.4g}", step, steps)
