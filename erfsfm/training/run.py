"""One training run: data in, an output folder that ``--weights`` takes out."""

from __future__ import annotations

import logging
import subprocess
import warnings
from pathlib import Path

import cv2
import lightning
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from torch.utils.data import DataLoader

import erfsfm
from erfsfm.checkpoint import Model, ModelRecord, load_model, save_model
from erfsfm.config import ExperimentConfig, dump_yaml
from erfsfm.data.recordings import Recording
from erfsfm.data.snippets import SnippetDraws, ValidationSnippets, split_recordings
from erfsfm.data.splits import merge
from erfsfm.errors import ConfigError, TrainingError
from erfsfm.inference import choose_device
from erfsfm.training.module import SelfSupervision

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

    Args:
        config: the experiment.
        output: receives ``config.yaml``, the best weights at its top, the latest under ``last/``,
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
    done_steps = _prepare_output(config, output, checkpoint, resume)
    training, validation = split_recordings(config.data)
    lightning.seed_everything(config.training.seed, verbose=False)
    module = SelfSupervision(config)
    if config.initial_weights and not resume:
        _start_from(module, config.initial_weights)
    keeper = WeightKeeper(output, trained_on(training), command)
    trainer = _trainer(config, output, device, quiet, keeper, bool(validation))
    batch = config.training.batch
    draws = SnippetDraws(training, config, config.training.steps * batch, done_steps * batch)
    workers = config.data.workers
    loader = DataLoader(draws, batch, num_workers=workers, worker_init_fn=_calm_worker, persistent_workers=workers > 0)
    validation_loader = DataLoader(ValidationSnippets(validation, config), 1) if validation else None
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*num_workers.*")
        warnings.filterwarnings("ignore", message=".*isinstance.treespec.*")
        trainer.fit(module, loader, validation_loader, ckpt_path=checkpoint if resume else None, weights_only=True)
    keeper.save(module, trainer.global_step)
    return output


def trained_on(recordings: list[Recording]) -> list[str]:
    """The leak record of these recordings: names with their frame ranges."""
    return merge(
        r.name if r.name.startswith("simulated/") else f"{r.name}[{r.start}:{r.start + len(r)}]" for r in recordings
    )


class WeightKeeper(Callback):
    """Writes weights that can be used at once: the latest under ``last/``, the best at the top."""

    def __init__(self, output: Path, seen: list[str], command: str) -> None:
        self._output = output
        self._seen = seen
        self._command = command
        self._best = float("inf")

    def on_validation_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Keep what was just validated."""
        if not trainer.sanity_checking and isinstance(module, SelfSupervision):
            self.save(module, trainer.global_step)

    def save(self, module: SelfSupervision, step: int) -> None:
        """Write ``last/``, and the top of the folder where the decisive measure is the best so far.

        True depth decides where validation has it, else the photometric error.
        """
        metrics = module.validation_metrics
        record = ModelRecord(
            network=module.config.network,
            trained_on=self._seen,
            licence=licence_of(self._seen),
            step=step,
            metrics=metrics,
            version=erfsfm.__version__,
            commit=commit(),
            command=self._command,
        )
        model = Model(record, module.depth_net, module.pose_net)
        save_model(self._output / "last", model)
        decisive = metrics.get("abs_rel", metrics.get("photometric"))
        if decisive is None or decisive < self._best:
            self._best = decisive if decisive is not None else self._best
            save_model(self._output, model)

    def state_dict(self) -> dict[str, float]:
        """The best so far survives a resume."""
        return {"best": self._best}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Take the best so far from a checkpoint."""
        self._best = state_dict["best"]


def licence_of(seen: list[str]) -> str:
    """Licence that weights inherit from what they saw."""
    if all(name.startswith("simulated/") for name in seen):
        return "MIT"
    if any(name.startswith(("kitti", "folder/kitti", "folder/karlsruhe")) for name in seen):
        return "CC BY-NC-SA 3.0 (trained on KITTI)"
    return "unknown: depends on the training data"


def commit() -> str:
    """The revision of the source tree this runs from, or an empty string outside one."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    return finished.stdout.strip()


def _prepare_output(config: ExperimentConfig, output: Path, checkpoint: Path, resume: bool) -> int:
    """Make the folder ready; the number of steps already done."""
    if resume and not checkpoint.is_file():
        raise TrainingError(
            f"nothing to resume in {output}: no {checkpoint.relative_to(output)}; start without --resume"
        )
    if not resume and checkpoint.is_file():
        raise TrainingError(f"{output} holds an unfinished run: go on with --resume or choose another --output")
    output.mkdir(parents=True, exist_ok=True)
    written = output / "config.yaml"
    text = dump_yaml(config)
    if resume:
        if written.is_file() and _network_part(written.read_text()) != _network_part(text):
            raise ConfigError(f"the networks of {written} differ from this configuration: resume with the same one")
        state = torch.load(checkpoint, map_location="cpu", weights_only=True)
        return int(state["global_step"])
    written.write_text(text)
    return 0


def _network_part(text: str) -> str:
    return text.split("\ndata:")[0]


def _start_from(module: SelfSupervision, name: str) -> None:
    model = load_model(name)
    if model.record.network != module.config.network:
        raise ConfigError(
            f"initial_weights '{name}' are of another network: {model.record.network.model_dump()}; set the same network"
        )
    module.depth_net.load_state_dict(model.depth_net.state_dict())
    module.pose_net.load_state_dict(model.pose_net.state_dict())


def _trainer(
    config: ExperimentConfig, output: Path, device: str, quiet: bool, keeper: WeightKeeper, validates: bool
) -> lightning.Trainer:
    training = config.training
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    latest = ModelCheckpoint(
        output / "checkpoints",
        filename="last",
        every_n_train_steps=training.checkpoint_every,
        save_top_k=1,
        enable_version_counter=False,
    )
    logs = [CSVLogger(output, "logs", "csv"), TensorBoardLogger(output, "logs", "tensorboard")]
    progress = [] if quiet else [TQDMProgressBar(refresh_rate=5)]
    return lightning.Trainer(
        accelerator="gpu" if choose_device(device).type == "cuda" else "cpu",
        devices=1,
        precision=training.precision,
        max_steps=training.steps,
        gradient_clip_val=training.gradient_clip or None,
        check_val_every_n_epoch=None,
        val_check_interval=training.validate_every if validates else None,
        num_sanity_val_steps=0,
        log_every_n_steps=training.log_every,
        logger=logs,
        callbacks=[latest, keeper, *progress],
        enable_progress_bar=not quiet,
        enable_model_summary=False,
        default_root_dir=output,
    )


def _calm_worker(_: int) -> None:
    """A worker decodes with one thread: the cores belong to the training step."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
