"""One training run: data in, an output folder that ``--weights`` takes out."""

from __future__ import annotations

import logging
import math
import os
import pickle
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import lightning
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.plugins import TorchCheckpointIO
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.utilities.warnings import PossibleUserWarning
from torch import Tensor
from torch.utils.data import DataLoader

import erfsfm
from erfsfm.checkpoint import Model, ModelRecord, commit, load_model, read_record, save_model
from erfsfm.config import ExperimentConfig, dump_yaml, load_experiment
from erfsfm.data.recordings import Recording
from erfsfm.data.snippets import SnippetDraws, ValidationSnippets, split_recordings
from erfsfm.data.splits import merge
from erfsfm.errors import ConfigError, DataError, TrainingError
from erfsfm.files import write_atomically
from erfsfm.inference import choose_device
from erfsfm.networks.transfer import take_over
from erfsfm.training.module import SelfSupervision
from erfsfm.training.progress import ProgressLine

logger = logging.getLogger(__name__)


def train(
    config: ExperimentConfig,
    output: Path,
    resume: bool = False,
    device: str = "auto",
    command: str = "",
    quiet: bool = True,
) -> Path:
    """Train, validate, keep the best.

    With several devices, Lightning starts this very program again for each further one; these end here.

    Args:
        config: the experiment.
        output: receives ``config.yaml``, the best weights at its top (see `decisive`), those with the best
            poses under ``best_pose/`` where true poses validate, the latest under ``last/``,
            ``checkpoints/last.ckpt`` for ``resume``, and CSV and TensorBoard logs under ``logs/``.
        resume: go on from ``checkpoints/last.ckpt``.
        device: ``auto``, ``cpu`` or ``cuda``.
        command: recorded in the weights.
        quiet: no progress bar.

    Returns:
        The output folder.

    Raises:
        ConfigError, DataError, TrainingError: what a user can mend, in one line.
    """
    checkpoint = output / "checkpoints" / "last.ckpt"
    training, validation = split_recordings(config.data)
    done_steps = _prepare_output(config, output, checkpoint, resume)
    lightning.seed_everything(config.training.seed, verbose=False)
    module = SelfSupervision(config)
    batch, workers = config.training.batch, config.data.workers
    together = batch * config.training.devices
    rank = int(os.environ.get("LOCAL_RANK", 0)) if config.training.devices > 1 else 0
    draws = SnippetDraws(training, config, config.training.steps * together, done_steps * together, rank)
    seen = trained_on(draws.recordings)
    if config.initial_weights and not resume:
        seen = merge([*seen, *_start_from(module, config.initial_weights)])
    keeper = WeightKeeper(output, seen, command, validates=bool(validation))
    loader = DataLoader(draws, batch, num_workers=workers, worker_init_fn=_calm_worker, persistent_workers=workers > 0)
    validation_loader = DataLoader(ValidationSnippets(validation, config), 1) if validation else None
    trainer = _trainer(config, output, device, quiet or rank > 0, keeper, done_steps)
    _fit(trainer, module, loader, validation_loader, checkpoint if resume else None)
    if not trainer.is_global_zero:
        sys.exit()
    keeper.save(module, trainer.global_step)
    return output


def trained_on(recordings: list[Recording]) -> list[str]:
    """The leak record of these recordings: names with their frame ranges."""
    return merge(r.name if r.name.startswith("simulated/") else r.frames_name for r in recordings)


def _fit(
    trainer: lightning.Trainer,
    module: SelfSupervision,
    loader: DataLoader[dict[str, Tensor]],
    validation_loader: DataLoader[dict[str, Tensor]] | None,
    checkpoint: Path | None,
) -> None:
    """Run the loop; what stops it becomes one line."""
    try:
        with _opencv_without_threads(), warnings.catch_warnings():
            warnings.simplefilter("ignore", PossibleUserWarning)
            warnings.filterwarnings("ignore", message=".*isinstance.treespec.*")
            warnings.filterwarnings("ignore", message=".*when using `ckpt_path`.*")
            warnings.filterwarnings("ignore", message=".*(Checkpoint|Experiment logs) directory.*")
            trainer.fit(module, loader, validation_loader, ckpt_path=checkpoint, weights_only=True)
    except DataError as error:
        # from a worker process it arrives with that process' traceback before its own last line
        raise DataError(str(error).strip().splitlines()[-1].removeprefix("erfsfm.errors.DataError: ")) from error
    except SystemExit as error:
        # Lightning turns Ctrl-C into an exit
        raise TrainingError(f"interrupted at step {trainer.global_step}: go on with --resume") from error


class WeightKeeper(Callback):
    """Writes weights that can be used at once: the latest, the best and those with the best poses.

    How long the last improvement is ago follows from the step in the best ones' record, so that a run
    that is killed and resumed stops where it would have stopped.
    """

    def __init__(self, output: Path, seen: list[str], command: str, validates: bool) -> None:
        self._output = output
        self._seen = seen
        self._command = command
        self.validates = validates
        self._best = {output: math.inf, output / "best_pose": math.inf}
        self._best_step = 0
        for folder in self._best:
            if (folder / "model.yaml").is_file():
                record = read_record(folder / "model.yaml")
                self._best[folder] = self._measures(record.metrics)[folder]
                if math.isfinite(self._best[folder]):
                    self._best_step = max(self._best_step, record.step)
        self._saved_step = -1

    def on_validation_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Keep what was just validated; end the run where the last improvement is too long ago."""
        if trainer.sanity_checking or not isinstance(module, SelfSupervision):
            return
        improved = self._improved(module.validation_metrics)
        if improved:
            self._best_step = trainer.global_step
        if trainer.is_global_zero:
            self.save(module, trainer.global_step)
        self._best |= improved
        training = module.config.training
        if training.patience and trainer.global_step - self._best_step >= training.patience * training.validate_every:
            trainer.should_stop = True
            logger.info(
                "stopped at step %d: no validation since step %d was better", trainer.global_step, self._best_step
            )

    def on_exception(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, exception: BaseException
    ) -> None:
        """Keep the weights so far, if they are numbers."""
        numbers = all(torch.isfinite(weights).all() for weights in module.parameters())
        if isinstance(module, SelfSupervision) and trainer.is_global_zero and trainer.global_step > 0 and numbers:
            save_model(self._output / "last", self._model(module, trainer.global_step))

    def save(self, module: SelfSupervision, step: int) -> None:
        """Write ``last/``; and the folders whose measure is the best so far.

        Without validation the last is the best.
        """
        if step == self._saved_step:
            return
        self._saved_step = step
        model = self._model(module, step)
        save_model(self._output / "last", model)
        folders = set(self._improved(module.validation_metrics))
        if not self.validates or not (self._output / "model.yaml").is_file():
            folders.add(self._output)
        for folder in folders:
            save_model(folder, model)

    def _model(self, module: SelfSupervision, step: int) -> Model:
        record = ModelRecord(
            network=module.config.network,
            trained_on=self._seen,
            licence=licence_of(self._seen),
            step=step,
            metrics=module.validation_metrics,
            version=erfsfm.__version__,
            commit=commit(),
            command=self._command,
        )
        return Model(record, module.depth_net, module.pose_net)

    def _measures(self, metrics: dict[str, float]) -> dict[Path, float]:
        """What each folder's weights are judged by; less is better."""
        pose = metrics.get("snippet_ate", math.inf)
        return {self._output: decisive(metrics), self._output / "best_pose": pose if math.isfinite(pose) else math.inf}

    def _improved(self, metrics: dict[str, float]) -> dict[Path, float]:
        return {folder: value for folder, value in self._measures(metrics).items() if value < self._best[folder]}

    def state_dict(self) -> dict[str, list[str]]:
        """What was seen survives a resume, also with other data."""
        return {"seen": self._seen}

    def load_state_dict(self, state_dict: dict[str, list[str]]) -> None:
        """Add what the run had seen before it was interrupted."""
        self._seen = merge([*self._seen, *state_dict.get("seen", [])])


def decisive(metrics: dict[str, float]) -> float:
    """What a validation is judged by: true depth where it has it, else the photometric error; less is better."""
    value = metrics.get("abs_rel", metrics.get("photometric", math.inf))
    return value if math.isfinite(value) else math.inf


def licence_of(seen: list[str]) -> str:
    """Licence that weights inherit from what they saw."""
    if all(name.startswith("simulated/") for name in seen):
        return "MIT"
    if any(name.startswith(("kitti", "folder/kitti", "folder/karlsruhe")) for name in seen):
        return "CC BY-NC-SA 3.0 (trained on KITTI)"
    return "unknown: depends on the training data"


def _prepare_output(config: ExperimentConfig, output: Path, checkpoint: Path, resume: bool) -> int:
    """Make the folder ready; the number of steps already done."""
    written = output / "config.yaml"
    for needed in (checkpoint, written):
        if resume and not needed.is_file():
            raise TrainingError(
                f"nothing to resume in {output}: no {needed.relative_to(output)}; start without --resume"
            )
    if not resume and (checkpoint.is_file() or (output / "model.yaml").is_file()):
        raise TrainingError(f"{output} holds a run already: go on with --resume or choose another --output")
    done_steps = 0
    if resume:
        begun = load_experiment(written)
        if begun.network != config.network:
            raise ConfigError(f"the networks of {written} differ from this configuration: resume with the same one")
        if begun.training.optimiser != config.training.optimiser:
            raise ConfigError(
                f"{written} began with training.optimiser {begun.training.optimiser}, whose state another cannot take "
                f"over; got {config.training.optimiser}: resume with the same one, or start anew from its weights"
            )
        done_steps = _steps_of(checkpoint)
    output.mkdir(parents=True, exist_ok=True)
    write_atomically(written, lambda path: path.write_text(dump_yaml(config)))
    return done_steps


def _steps_of(checkpoint: Path) -> int:
    """Steps done at a checkpoint. Only tensors and plain values are read: no code in it can run."""
    try:
        state = torch.load(checkpoint, map_location="cpu", weights_only=True)
        missing = {"global_step", "state_dict", "optimizer_states", "loops"} - set(state)
        if missing:
            raise KeyError(*sorted(missing))
        return int(state["global_step"])
    except (pickle.UnpicklingError, EOFError, RuntimeError, ValueError, TypeError, KeyError) as error:
        raise TrainingError(
            f"{checkpoint} is damaged or no checkpoint of erfsfm: it cannot be resumed; start anew in another --output"
        ) from error


def _start_from(module: SelfSupervision, name: str) -> list[str]:
    """Take over trained weights, of another variant or half the width too; what they were trained on."""
    model = load_model(name)
    wanted = module.config.network
    free = {key: getattr(wanted, key) for key in ("depth", "pose", "depth_width", "pose_width")}
    try:
        if model.record.network.model_copy(update=free) != wanted:
            raise ConfigError("only presets and widths may differ")
        take_over(module.depth_net, model.depth_net.state_dict())
        take_over(module.pose_net, model.pose_net.state_dict())
    except ConfigError as error:
        raise ConfigError(
            f"initial_weights '{name}' are of another network, {model.record.network.model_dump()}: {error}"
        ) from error
    return model.record.trained_on


def _trainer(
    config: ExperimentConfig, output: Path, device: str, quiet: bool, keeper: WeightKeeper, done_steps: int
) -> lightning.Trainer:
    training = config.training
    on_cpu = choose_device(device).type == "cpu"
    precision = training.precision
    if on_cpu and precision == "16-mixed":
        logger.warning("training.precision 16-mixed needs a GPU: bf16-mixed is used on this CPU")
        precision = "bf16-mixed"
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    latest = ModelCheckpoint(
        output / "checkpoints",
        filename="last",
        every_n_train_steps=training.checkpoint_every,
        save_top_k=1,
        enable_version_counter=False,
    )
    # Lightning's CSV log starts by deleting an older one of its name
    csv = f"csv_from_{done_steps}" if done_steps else "csv"
    logs = [CSVLogger(output, "logs", csv), TensorBoardLogger(output, "logs", "tensorboard")]
    progress = [] if quiet else [ProgressLine(training.batch * training.devices)]
    several = training.devices > 1
    return lightning.Trainer(
        accelerator="cpu" if on_cpu else "gpu",
        devices=training.devices,
        # a term or a scale that is switched off leaves weights without gradient
        strategy=DDPStrategy(find_unused_parameters=True) if several else "auto",
        sync_batchnorm=several and not on_cpu,
        use_distributed_sampler=False,  # the draws are dealt out already, and every process validates everything
        precision=precision,
        max_steps=training.steps,
        gradient_clip_val=training.gradient_clip or None,
        check_val_every_n_epoch=None,
        val_check_interval=training.validate_every if keeper.validates else None,
        num_sanity_val_steps=0,
        log_every_n_steps=training.log_every,
        logger=logs,
        callbacks=[latest, keeper, *progress],
        plugins=[AtomicCheckpoints()],
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=output,
    )


class AtomicCheckpoints(TorchCheckpointIO):
    """A checkpoint replaces the last one at once, or not at all: Lightning's goes through another file system."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write ``checkpoint`` to ``path``."""
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(Path(path), lambda part: torch.save(checkpoint, part))


@contextmanager
def _opencv_without_threads() -> Iterator[None]:
    """End OpenCV's threads while workers are forked: a child waits forever for threads it did not inherit."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _calm_worker(_: int) -> None:
    """A worker computes with one thread: the cores belong to the training step."""
    torch.set_num_threads(1)
