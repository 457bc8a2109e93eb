"""Weights that a run writes: the latest, the best, and their records."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback

import erfsfm
from erfsfm.checkpoint import KINDS, Absent, Model, save_model
from erfsfm.common.errors import TrainingError
from erfsfm.config import TrainedNetworks
from erfsfm.data.splits import merge
from erfsfm.model_record import ModelRecord, commit, read_record
from erfsfm.training.module import SelfSupervision

logger = logging.getLogger(__name__)


class WeightKeeper(Callback):
    """Writes weights folders: the latest, the best, and those with the best poses.

    The best is chosen by what is trained, `decisive`; poses of a network that keeps its weights have no best.
    The step of the last improvement is read from the record of the best weights, so that a run that is
    killed and resumed stops at the same step as an uninterrupted one.
    """

    def __init__(self, output: Path, seen: list[str], command: str, validates: bool, networks: TrainedNetworks) -> None:
        self._output = output
        self._seen = seen
        self._command = command
        self.validates = validates
        self._networks = networks
        self._best = dict.fromkeys(self._measures({}), math.inf)
        self._best_step = 0
        for folder in self._best:
            if (folder / "model.yaml").is_file():
                record = read_record(folder / "model.yaml")
                self._best[folder] = self._measures(record.metrics)[folder]
                if math.isfinite(self._best[folder]):
                    self._best_step = max(self._best_step, record.step)
        self._saved_step = -1

    def on_train_batch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Ask for a stop after the last step: Lightning then validates once more."""
        if self.validates and trainer.global_step >= trainer.max_steps:
            trainer.should_stop = True

    def on_validation_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Write the validated weights; end the run after `patience` validations without improvement."""
        if trainer.sanity_checking or not isinstance(module, SelfSupervision):
            return
        improved = self._improved(module.validation_metrics)
        if improved:
            self._best_step = trainer.global_step
        if trainer.is_global_zero:
            self.save(module, trainer.global_step)
        self._best |= improved
        training = module.config.training
        since = trainer.global_step - self._best_step
        if training.patience and self._best_step and since >= training.patience * training.validate_every:
            trainer.should_stop = True
            logger.info(
                "stopped at step %d: no validation since step %d was better", trainer.global_step, self._best_step
            )

    def on_exception(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, exception: BaseException
    ) -> None:
        """Keep the weights so far, if they are finite."""
        if not isinstance(module, SelfSupervision) or not trainer.is_global_zero or trainer.global_step == 0:
            return
        if _all_finite(module):
            save_model(self._output / "last", self._model(module, trainer.global_step))

    def save(self, module: SelfSupervision, step: int) -> None:
        """Write ``last/``, and the folders whose metric is the best so far.

        Where validation measures nothing, or there is none, the last is the best.

        Raises:
            TrainingError: weights are NaN or infinite; nothing is written.
        """
        if step == self._saved_step:
            return
        if not _all_finite(module):
            raise TrainingError(
                f"weights are NaN or infinite at step {step}: lower training.learning_rate, or set "
                "training.gradient_clip or training.precision=32-true, and start again; older weights are in last/"
            )
        self._saved_step = step
        model = self._model(module, step)
        save_model(self._output / "last", model)
        folders = set(self._improved(module.validation_metrics))
        if not self.validates or math.isinf(self._best[self._output]):
            folders.add(self._output)
        for folder in folders:
            save_model(folder, model)

    def metrics_at(self, step: int) -> dict[str, float]:
        """The measurements of the latest weights, if these are of the given step; else nothing."""
        record = self._output / "last" / "model.yaml"
        latest = read_record(record) if record.is_file() else None
        return latest.metrics if latest is not None and latest.step == step else {}

    def _model(self, module: SelfSupervision, step: int) -> Model:
        record = ModelRecord(
            network=module.config.network,
            networks=module.known,
            trained_on=self._seen,
            licence=licence_of(self._seen),
            step=step,
            metrics=module.validation_metrics,
            version=erfsfm.__version__,
            commit=commit(),
            command=self._command,
        )
        depth_net, pose_net = (
            module.network(kind) if module.known in ("both", kind) else Absent(kind, self._output) for kind in KINDS
        )
        return Model(record, depth_net, pose_net)

    def _measures(self, metrics: dict[str, float]) -> dict[Path, float]:
        """The metric by which each folder's weights are chosen; less is better."""
        measures = {self._output: decisive(metrics, self._networks)}
        if self._networks != "depth":
            pose = metrics.get("snippet_ate", math.inf)
            measures[self._output / "best_pose"] = pose if math.isfinite(pose) else math.inf
        return measures

    def _improved(self, metrics: dict[str, float]) -> dict[Path, float]:
        return {folder: value for folder, value in self._measures(metrics).items() if value < self._best[folder]}

    def state_dict(self) -> dict[str, list[str]]:
        """Recordings trained on, kept over a resume with other data."""
        return {"seen": self._seen}

    def load_state_dict(self, state_dict: dict[str, list[str]]) -> None:
        """Add the recordings trained on before the interruption."""
        self._seen = merge([*self._seen, *state_dict.get("seen", [])])


def _all_finite(module: SelfSupervision) -> bool:
    return all(bool(torch.isfinite(weights).all()) for weights in module.parameters())


def decisive(metrics: dict[str, float], networks: TrainedNetworks = "both") -> float:
    """The metric of a validation: error of depth, of poses where these alone are trained; less is better.

    Without ground truth it is the photometric error, which needs both networks; else infinite.
    """
    value = metrics.get("snippet_ate" if networks == "pose" else "abs_rel", metrics.get("photometric", math.inf))
    return value if math.isfinite(value) else math.inf


def licence_of(seen: list[str]) -> str:
    """Licence that weights inherit from their training data."""
    if all(name.startswith("simulated/") for name in seen):
        return "MIT"
    if any(name.startswith(("kitti", "folder/kitti", "folder/karlsruhe")) for name in seen):
        return "CC BY-NC-SA 3.0 (trained on KITTI)"
    return "unknown: depends on the training data"
