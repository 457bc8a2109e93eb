"""One training run; its output folder is what ``--weights`` takes. Labels are measured before the first step."""

from __future__ import annotations

import io
import logging
import os
import shutil
import signal
import sys
import tempfile
import warnings
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.fabric.plugins.environments import LightningEnvironment
from lightning.pytorch.callbacks import ModelCheckpoint, Timer
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.plugins import TorchCheckpointIO
from lightning.pytorch.strategies import DDPStrategy
from lightning.pytorch.utilities.warnings import PossibleUserWarning
from torch import Tensor
from torch.utils.data import DataLoader

from erfsfm.checkpoint import load_model, take_over
from erfsfm.common.errors import ConfigError, TrainingError
from erfsfm.common.files import FolderLock, write_atomically
from erfsfm.common.processes import opencv_threads
from erfsfm.common.progress import Progress, silent
from erfsfm.common.readers.frame_range import merge
from erfsfm.common.signals import Terminated, raising_on_termination
from erfsfm.config import UNTRAINED, ExperimentConfig, dump_yaml
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.data.prepared import write_prepared
from erfsfm.data.recordings import Recording
from erfsfm.data.snippets import SnippetDraws, ValidationSnippets, by_label, labels_mb, stacked
from erfsfm.data.split import split_recordings, usable
from erfsfm.evaluation.depth_protocols import many_view_protocol
from erfsfm.inference import DepthPosePredictor, choose_device, has_bfloat16, learned_inverse_depth
from erfsfm.model_record import find_weights, read_record
from erfsfm.networks.lite0 import Lite0DepthNet
from erfsfm.training.module import SelfSupervision
from erfsfm.training.objective import needs_poses
from erfsfm.training.output_folder import MEASUREMENTS, OutputFolder, StepProgress, WeightKeeper

logger = logging.getLogger(__name__)

_LOGGED_EVERY = (
    50  # steps: a hundredth of the shortest useful training; a shorter one is logged at its end
)
_BATCHES_AHEAD = 2  # of each data loader, by PyTorch
_LABEL_BYTES = 12  # of a pixel: bounds of depth, and where they are known
_LEFT_OUT = ("method", "leak")  # the same in all rows


def train(
    config: ExperimentConfig,
    output: Path,
    resume: bool = False,
    device: str = "auto",
    command: str = "",
    progress: Progress = silent,
    camera: Path | None = None,
) -> Path:
    """Train, validate, keep the best in the folder that is returned; further processes of several devices exit here.

    Args:
        config: the experiment.
        output: receives ``config.yaml``, the best weights at its top (see `decisive`), those with the best
            poses under ``best_pose/`` where poses are trained and true ones validate, the latest under ``last/``,
            ``checkpoints/last.ckpt`` for ``resume``, and CSV and TensorBoard logs under ``logs/``.
        resume: continue from ``checkpoints/last.ckpt``.
        device: ``auto``, ``cpu`` or ``cuda``.
        command: recorded in the weights.
        progress: told of the stage, what is done, and of how many.
        camera: the camera file of a user's images and videos, in place of those beside them; ``auto`` finds it.

    Raises:
        ConfigError, DataError, TrainingError: configuration, data or output folder cannot be used; one line.
    """
    on_cpu = choose_device(device) == "cpu"
    there = (os.cpu_count() or 1) if on_cpu else torch.cuda.device_count()
    if (devices := config.training.devices) > there:
        raise ConfigError(
            f"training.devices is {devices} on a machine with {there}: set {there} or fewer"
        )
    folder = OutputFolder(output)
    rank = LightningEnvironment().local_rank()
    done_steps = folder.resumable_steps(config) if resume else 0
    if rank == 0 and not resume:  # the first process has written there before it starts the others
        folder.require_free()
    measured = config.teacher.cache or output / MEASUREMENTS
    training, validation = split_recordings(config.data, camera, measured)
    if config.data.validation and not validation and rank == 0:
        logger.warning(
            "training runs without validation: no recording of data.validation is among the data"
        )
    lightning.seed_everything(config.training.seed, verbose=False)
    timer = Timer(
        timedelta(minutes=config.training.minutes) or None, verbose=False
    )  # keeps its time in checkpoints
    module, workers = SelfSupervision(config, timer.time_elapsed), _workers(config)
    draws = _draws(config, training, done_steps, measured, progress)
    validation_loader = (
        DataLoader(ValidationSnippets(validation, config), 1) if validation else None
    )
    before = [] if resume else _start_from(module, config)
    seen = merge([*trained_on(draws.recordings), *before, *seen_by_imitated(config)])
    keeper = WeightKeeper(
        output, seen, command, bool(validation), config.training, choose_device(device)
    )
    if resume:
        module.validation_metrics = keeper.metrics_at(done_steps)
    loader = DataLoader(
        draws, config.training.batch, num_workers=workers, pin_memory=not on_cpu, collate_fn=stacked
    )
    trainer = _trainer(config, output, device, (keeper, timer, StepProgress(progress)), done_steps)
    with raising_on_termination(), FolderLock() as lock:
        if rank == 0:
            lock.take(output)
            write_atomically(folder.config, dump_yaml(config))
        _fit(trainer, module, loader, validation_loader, folder.checkpoint, resume)
    keeper.save(trainer, module)
    if not trainer.is_global_zero:
        sys.exit()
    module.require_depth()
    return output


def prepare(
    config: ExperimentConfig, output: Path, progress: Progress = silent, camera: Path | None = None
) -> None:
    """Write the frames and labels of a training to a folder, to train from elsewhere; see `write_prepared`.

    Raises:
        ConfigError: ``output`` is taken, or the last part of each recording is to validate on.
        DataError: nothing to train on.
        TrainingError: the teacher cannot measure a drive.
    """
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise ConfigError(
            f"--prepare {output} is not empty: choose a new folder; nothing was changed"
        )
    if config.data.validation_share > 0:  # it would be taken off again
        raise ConfigError(
            "--prepare keeps whole recordings to validate on: set data.validation_share=0"
        )
    with tempfile.TemporaryDirectory() as temporary:
        measured = config.teacher.cache or Path(temporary)
        training, validation = split_recordings(config.data, camera, measured)
        training = usable(training, config.network.sources + 1)
        held_out = ValidationSnippets(validation, config).snippets if validation else []
        teacher = measured_views(training, config, measured, progress)
        write_prepared(output, training, held_out, teacher, config.network, progress)


def depth_before_and_after(
    config: ExperimentConfig,
    output: Path,
    device: str,
    progress: Progress,
    camera: Path | None = None,
) -> list[dict[str, Any]]:
    """Errors by many views, a row for each held-out stretch by the initial weights, then by the trained ones.

    Args:
        config: of the training, with initial weights.
        output: its weights.
        device: ``auto``, ``cpu`` or ``cuda``.
        progress: told of the stage, what is done, and of how many.
        camera: as of the training.

    Raises:
        DataError, TrainingError: no depth could be measured there.
    """
    cache, rows = config.teacher.cache or output / MEASUREMENTS, []
    _, validation = split_recordings(config.data, camera, cache)
    for when, weights in (("before", config.initial_weights), ("after", str(output))):
        networks = DepthPosePredictor.from_weights(weights, device)
        errors = many_view_protocol(networks, validation, cache, True, progress)
        rows += [
            {"depth": when} | {key: row[key] for key in row if key not in _LEFT_OUT}
            for row in errors
        ]
    return rows


def _workers(config: ExperimentConfig) -> int:
    """Data loaders that fit into shared memory, where each hands over batches: in containers it is small.

    One for which there is no room would end, and the training would wait for it for ever.
    """
    workers, network, shared = config.data.workers, config.network, Path("/dev/shm")
    if not workers or not shared.is_dir():
        return workers
    sample = network.height * network.width * (3 * (network.sources + 1) + _LABEL_BYTES)
    wanted = (_BATCHES_AHEAD * workers + 1) * config.training.batch * sample
    free = shutil.disk_usage(shared).free
    if wanted < free:
        return workers
    logger.warning(
        "/dev/shm has %.1f MB free, and %d data loaders want %.1f: the training reads its data itself, "
        "which is slower; start the container with --shm-size=2g, or set data.workers=0",
        *(free / 1e6, workers, wanted / 1e6),
    )
    return 0


def _draws(
    config: ExperimentConfig,
    training: list[Recording],
    done_steps: int,
    measured: Path,
    progress: Progress,
) -> SnippetDraws:
    """What this process trains on after some steps."""
    together = config.training.batch * config.training.devices
    views = measured_views(training, config, measured, progress)
    last, done = config.training.steps * together, done_steps * together
    imitates = config.teacher.views == "network"
    imitated = partial(learned_inverse_depth, config.teacher.slam_weights) if imitates else None
    return SnippetDraws(
        training, config, last, done, LightningEnvironment().local_rank(), views, imitated
    )


def trained_on(recordings: list[Recording]) -> list[str]:
    """The leak record of these recordings: names with their frame ranges."""
    return merge(r.name if r.name.startswith("simulated/") else r.frames_name for r in recordings)


def _fit(
    trainer: lightning.Trainer,
    module: SelfSupervision,
    loader: DataLoader[dict[str, Tensor]],
    validation_loader: DataLoader[dict[str, Tensor]] | None,
    checkpoint: Path,
    resume: bool,
) -> None:
    """Run the training loop; errors that stop it become one line."""
    try:
        with opencv_threads(1), warnings.catch_warnings():
            warnings.simplefilter("ignore", PossibleUserWarning)
            warnings.filterwarnings(
                "ignore", ".*(treespec|ckpt_path|dirpath has|Checkpoint directory|logs directory)"
            )
            trainer.fit(
                module,
                loader,
                validation_loader,
                ckpt_path=checkpoint if resume else None,
                weights_only=True,
            )
    except (SystemExit, RuntimeError) as error:
        again = (
            "continue with --resume"
            if checkpoint.is_file()
            else "start again, for it has no checkpoint yet"
        )
        if isinstance(error, SystemExit):  # Lightning turns ctrl-C into one
            number = getattr(error, "number", signal.SIGINT)
            raise Terminated(number, f" at step {trainer.global_step}: {again}") from error
        if "DataLoader worker" not in str(error):
            raise
        raise TrainingError(
            f"a data loader was killed, for want of memory or by a signal: {again}"
        ) from error


def _start_from(module: SelfSupervision, config: ExperimentConfig) -> list[str]:
    """Load initial weights, also of another variant; returns what they were trained on."""
    name, wanted = config.initial_weights, config.network
    model = None if name in UNTRAINED else load_model(name)
    loaded = {} if model is None else model.networks
    if config.training.networks == "depth" and "pose" not in loaded and needs_poses(config):
        raise ConfigError(
            "training.networks: depth warps images by the motion of a pose network that was trained before, and there "
            "is none: name weights that have one as initial_weights, or set teacher.views=many, or "
            "loss.photometric_weight=0"
        )
    if name != "none" and "depth" not in loaded and isinstance(module.depth_net, Lite0DepthNet):
        module.depth_net.encoder.take_imagenet()
    if model is None:
        return []
    free = {key: getattr(wanted, key) for key in ("depth", "pose", "alignment")}
    try:
        if model.record.network.model_copy(update=free) != wanted:
            raise ConfigError("only presets and alignment may differ")
        for kind, trained in loaded.items():
            take_over(module.network(kind), trained.state_dict())
    except ConfigError as error:
        raise ConfigError(f"initial_weights '{name}' are of another network: {error}") from error
    if model.record.networks != module.known:
        module.known = "both"
    if (model.record.network.depth, model.record.network.depth_width) == (
        wanted.depth,
        wanted.depth_width,
    ):
        module.depth_input = model.record.depth_input
    return model.record.trained_on


def _trainer(
    config: ExperimentConfig,
    output: Path,
    device: str,
    callbacks: tuple[WeightKeeper, Timer, StepProgress],
    done_steps: int,
) -> lightning.Trainer:
    training = config.training
    on_cpu = choose_device(device) == "cpu"
    precision = training.precision
    if on_cpu and precision != "32-true":
        precision = "bf16-mixed" if has_bfloat16() else "32-true"
        if precision != training.precision:
            said = "training.precision %s does not fit this processor: %s is used"
            logger.warning(said, training.precision, precision)
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
    average = [callbacks[0].average] if callbacks[0].average else []
    several = training.devices > 1
    return lightning.Trainer(
        accelerator="cpu" if on_cpu else "gpu",
        devices=training.devices,
        strategy=DDPStrategy(find_unused_parameters=True) if several else "auto",
        sync_batchnorm=several and not on_cpu,
        use_distributed_sampler=False,  # each process has its own draws, and all validate everything
        precision=precision,
        benchmark=not on_cpu,  # every step has the same sizes
        max_steps=training.steps,
        gradient_clip_val=training.gradient_clip or None,
        check_val_every_n_epoch=None,
        val_check_interval=training.validate_every if callbacks[0].validates else None,
        num_sanity_val_steps=0,
        log_every_n_steps=min(_LOGGED_EVERY, training.steps),
        logger=logs,
        callbacks=[latest, *callbacks, *average],
        plugins=[AtomicCheckpoints()],
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=output,
    )


class AtomicCheckpoints(TorchCheckpointIO):
    """Checkpoints that are replaced atomically; Lightning's go through another file system."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write ``checkpoint`` to ``path``."""
        content = io.BytesIO()  # as in `save_model`
        torch.save(checkpoint, content)
        write_atomically(Path(path), content.getvalue())


def seen_by_imitated(config: ExperimentConfig) -> list[str]:
    """What the imitated network was trained on, and the network that imitates it has then seen, too.

    Raises:
        CheckpointError: there are no such weights.
        ConfigError: they have no depth network.
    """
    name = config.teacher.slam_weights
    if config.teacher.views != "network":
        return []
    record = read_record(find_weights(name) / "model.yaml")
    if record.networks == "pose":
        raise ConfigError(
            f"teacher.slam_weights '{name}' have no depth network to imitate: name weights that have one"
        )
    return record.trained_on


def measured_views(
    recordings: list[Recording], config: ExperimentConfig, folder: Path, progress: Progress
) -> ManyViewTeacher | None:
    """The teacher, with what is not there yet measured; None where the experiment has no many views.

    Args:
        recordings: to train on; those with exact depth need no measurement.
        config: of the experiment.
        folder: of the measurements.
        progress: told of the stage, what is done, and of how many.
    """
    exact, measured = by_label(recordings, config)
    if exact:
        others = ", ".join(dict.fromkeys(recording.name for recording in measured))
        logger.info("recordings with exact depth: %d; without: %s", len(exact), others)
    if config.teacher.views != "many":
        return None
    size = (config.network.height, config.network.width)
    with_depth = config.training.networks != "pose"
    learned = partial(learned_inverse_depth, config.teacher.slam_weights)
    teacher = ManyViewTeacher(
        folder, size, config.teacher.stride, labels_mb(config.data), with_depth, learned
    )
    teacher.prepare(measured, config.network.sources, config.teacher.slam_weights, progress)
    return teacher
