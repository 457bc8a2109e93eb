"""The output folder of a training run.

What may lie in it before a run begins, what a resumed one needs, the latest and the best weights
that a training leaves in it while it runs, and what is said of its steps.
"""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, WeightAveraging
from torch.optim.swa_utils import get_ema_multi_avg_fn

import erfsfm
from erfsfm.checkpoint import Model, read_torch, save_model
from erfsfm.common.errors import ConfigError, TrainingError
from erfsfm.common.progress import Progress, duration
from erfsfm.common.readers.frame_range import merge
from erfsfm.config import ExperimentConfig, TrainingConfig, load_experiment
from erfsfm.model_record import ModelRecord, commit, read_record
from erfsfm.training.module import SelfSupervision, decisive

logger = logging.getLogger(__name__)

CONFIG = "config.yaml"
MEASUREMENTS = "teacher"  # measured before a run begins, and kept if it is interrupted there
_BEGUN = {
    CONFIG,
    "checkpoints",
    "logs",
    "last",
    "best_pose",
    MEASUREMENTS,
}  # left by a run that failed before its first weights
_TIMED_STEPS, _TIMED_S = 20, 30.0  # whichever comes first


class OutputFolder:
    """The folder of one run; one that holds files of others is never written to."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoint, self.config = path / "checkpoints" / "last.ckpt", path / CONFIG

    def require_free(self) -> None:
        """Accept a folder that is new, empty, or of a run that failed before its first checkpoint.

        Raises:
            TrainingError, ConfigError: a run with weights, or files that no training wrote; one line.
        """
        if not self.path.exists():
            return
        if not self.path.is_dir():
            raise TrainingError(
                f"--output {self.path} is a file, not a folder: choose another --output"
            )
        if self.checkpoint.is_file() or (self.path / "model.yaml").is_file():
            raise TrainingError(
                f"{self.path} holds a run already: continue with --resume or choose another --output"
            )
        names = {entry.name for entry in self.path.iterdir() if ".partial." not in entry.name}
        foreign = sorted(names - _BEGUN)
        if foreign:
            raise TrainingError(
                f"{self.path} holds files that 'erfsfm train' did not write ({foreign[0]}): choose a new or empty "
                "--output; nothing was changed"
            )
        if self.config.is_file():
            load_experiment(self.config)  # of another program it would be replaced

    def resumable_steps(self, config: ExperimentConfig) -> int:
        """Steps done at the last checkpoint.

        Raises:
            TrainingError: nothing to resume, or a damaged checkpoint; one line.
            ConfigError: the run began with another network, or with what the optimiser's state does not fit; one line.
        """
        for needed in (self.checkpoint, self.config):
            if not needed.is_file():
                raise TrainingError(
                    f"nothing to resume in {self.path}: no {needed.name}; start without --resume"
                )
        wrong = "is damaged or no checkpoint: start again in another --output"
        state = read_torch(self.checkpoint, TrainingError, wrong)
        known = {"global_step", "state_dict", "optimizer_states", "loops", "known"}
        is_whole = isinstance(state, dict) and known <= state.keys()
        if not is_whole or {name.partition(".")[0] for name in state["state_dict"]} != {
            "depth_net",
            "pose_net",
        }:
            raise TrainingError(f"{self.checkpoint} {wrong}")
        begun = load_experiment(self.config)
        if begun.network != config.network:
            raise ConfigError(
                f"the networks of {self.config} differ from this configuration: resume with the same one"
            )
        for key in ("networks", "frozen_stages"):
            before, now = getattr(begun.training, key), getattr(config.training, key)
            if before != now:
                raise ConfigError(
                    f"{self.config} began with training.{key} {before}; got {now}: resume with the same"
                )
        return int(state["global_step"])


class Average(WeightAveraging):
    """Moving average of the weights; in validations, until every callback before this one has seen their end, and after
    the training the module has it for its own weights."""

    def __init__(self, decay: float, device: str) -> None:
        super().__init__(torch.device(device), multi_avg_fn=get_ema_multi_avg_fn(decay))

    def on_validation_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Leave the average in the module."""

    def on_validation_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Give the module its own weights back."""
        super().on_validation_epoch_end(trainer, module)

    def end_early(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Give the module the average in the midst of a training, which is not to go on."""
        if self._average_model is not None and not trainer.validating:
            self._copy_average_to_current(module)


class WeightKeeper(Callback):
    """Writes weights folders: the latest, the best, and those with the best poses.

    The best is chosen by what is trained, `decisive`; poses of a network that keeps its weights have no best.
    Lightning's `ModelCheckpoint` keeps the state of the loop, but it cannot keep these: the output folder may be moved
    before a resume, and holds the latest weights as long as nothing was measured.
    """

    def __init__(
        self,
        output: Path,
        seen: list[str],
        command: str,
        validates: bool,
        training: TrainingConfig,
        device: str = "cpu",
    ) -> None:
        self._output = output
        self.average = (
            Average(training.average_decay, device) if training.average_decay > 0 else None
        )
        self._seen = seen
        self._command = command
        self.validates = validates
        self._networks = training.networks
        self._best = dict.fromkeys(self._measures({}), math.inf)
        for folder in self._best:
            if (folder / "model.yaml").is_file():
                self._best[folder] = self._measures(read_record(folder / "model.yaml").metrics)[
                    folder
                ]
        self._saved_step = -1

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Ask for a stop after the last step: Lightning then validates once more."""
        if self.validates and trainer.global_step >= trainer.max_steps:
            trainer.should_stop = True

    def on_validation_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Write the validated weights."""
        assert isinstance(module, SelfSupervision)
        self.save(trainer, module)

    def on_exception(
        self,
        trainer: lightning.Trainer,
        module: lightning.LightningModule,
        exception: BaseException,
    ) -> None:
        """Keep the weights so far, if they are finite."""
        assert isinstance(module, SelfSupervision)
        if self.average is not None:
            self.average.end_early(trainer, module)
        if trainer.is_global_zero and trainer.global_step > 0 and _all_finite(module):
            save_model(self._output / "last", self._model(module, trainer.global_step))

    def save(self, trainer: lightning.Trainer, module: SelfSupervision) -> None:
        """Write ``last/``, and the folders whose metric is the best so far; the first process alone does.

        Where validation measures nothing, or there is none, the last is the best.

        Raises:
            TrainingError: weights are NaN or infinite; nothing is written.
        """
        step = trainer.global_step
        if step == self._saved_step:
            return
        if not _all_finite(module):
            raise TrainingError(
                f"weights are NaN or infinite at step {step}: lower training.learning_rate, or set "
                "training.gradient_clip or training.precision=32-true, and start again; older weights are in last/"
            )
        self._saved_step = step
        if not trainer.is_global_zero:
            return
        model = self._model(module, step)
        save_model(self._output / "last", model)
        measured = self._measures(module.validation_metrics)
        improved = {
            folder: value for folder, value in measured.items() if value < self._best[folder]
        }
        folders = set(improved)
        if not self.validates or math.isinf(self._best[self._output]):
            folders.add(self._output)
        for folder in folders:
            save_model(folder, model)
        self._best |= improved

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
            depth_input=module.depth_input,
            step=step,
            metrics=module.validation_metrics,
            version=erfsfm.__version__,
            commit=commit(),
            command=self._command,
        )
        return Model(record, {kind: module.network(kind) for kind in record.kinds})

    def _measures(self, metrics: dict[str, float]) -> dict[Path, float]:
        """The metric by which each folder's weights are chosen; less is better."""
        measures = {self._output: decisive(metrics, self._networks)}
        if self._networks != "depth":
            pose = metrics.get("snippet_ate", math.inf)
            measures[self._output / "best_pose"] = pose if math.isfinite(pose) else math.inf
        return measures

    def state_dict(self) -> dict[str, list[str]]:
        """Recordings trained on, kept over a resume with other data."""
        return {"seen": self._seen}

    def load_state_dict(self, state_dict: dict[str, list[str]]) -> None:
        """Add the recordings trained on before the interruption."""
        self._seen = merge([*self._seen, *state_dict["seen"]])


def _all_finite(module: SelfSupervision) -> bool:
    return all(bool(torch.isfinite(weights).all()) for weights in module.parameters())


def licence_of(seen: list[str]) -> str:
    """Licence that weights inherit from their training data."""
    if all(name.startswith("simulated/") for name in seen):
        return "MIT"
    if any(name.startswith(("kitti", "folder/kitti", "folder/karlsruhe")) for name in seen):
        return "CC BY-NC-SA 3.0 (trained on KITTI)"
    return "unknown: depends on the training data"


def how_good(folder: Path) -> str:
    """What the last validation measured, and the command that measures the weights on other data."""
    record = read_record(folder / "model.yaml")
    units = {
        "abs_rel": "AbsRel {:.3f}",
        "snippet_ate": "snippet ATE {:.4f} m",
        "photometric": "photometric error {:.4f}",
    }
    measured = [
        text.format(record.metrics[key])
        for key, text in units.items()
        if math.isfinite(record.metrics.get(key, math.nan))
    ]
    kind, data = ("pose", "KITTI --sequence 09") if record.networks == "pose" else ("depth", "ROOT")
    said = f"validation: {', '.join(measured)}" if measured else "they were not validated"
    return (
        f"{said}; errors on other data: erfsfm evaluate {kind} --weights {folder} --dataset {data}"
    )


class StepProgress(Callback):
    """Tells of all steps, also after a resume, and of the loss of the latest; logs what a step takes."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._began: tuple[int, float] | None = None
        self._said = False

    def on_train_batch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, *_: Any
    ) -> None:
        """Tell of a step."""
        assert isinstance(module, SelfSupervision)
        if not trainer.is_global_zero:
            return
        step, now_s = trainer.global_step, time.monotonic()
        steps = round(
            step / module.progress(step)
        )  # fewer than asked for where the time ends before
        first, began_s = self._began = self._began or (step, now_s)
        timed = step - first >= min(_TIMED_STEPS, steps - first) or now_s - began_s >= _TIMED_S
        if timed and step > first and not self._said:
            self._said = True
            took_s = (now_s - began_s) / (step - first)
            logger.info(
                "a step takes %.2g s, all %d steps take %s",
                took_s,
                steps,
                duration(round(steps * took_s)),
            )
        self._progress(f"steps, loss {module.loss:.4g}", step, steps)
