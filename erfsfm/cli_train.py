"""The commands of ``erfsfm`` that train: networks, and the fusion of depth."""

from __future__ import annotations

import logging
import math
import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from erfsfm.cli_options import Device, Json, Seed, Weights, print_rows
from erfsfm.common.errors import ErfsfmError
from erfsfm.common.progress import progress_bar

logger = logging.getLogger(__name__)


def train(
    config: Annotated[str, typer.Option(help="a YAML file, or the name of a shipped configuration")],
    dataset: Annotated[
        list[Path] | None,
        typer.Option(help="KITTI odometry or raw root, image folder, video or prepared folder; repeat"),
    ] = None,
    output: Annotated[Path, typer.Option(help="receives weights, checkpoints and logs")] = Path("runs/train"),
    prepare: Annotated[
        Path | None,
        typer.Option(
            help="write the frames, at the networks' size, and the labels to this folder, and stop: it is a "
            "--dataset for the same training elsewhere"
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="resume from the last checkpoint in OUTPUT")] = False,
    overrides: Annotated[list[str] | None, typer.Option("--set", help="section.key=value; repeat")] = None,
    seed: Annotated[int | None, typer.Option(help="overrides training.seed")] = None,
    device: Device = "auto",
) -> None:
    """Train a depth and a pose network; OUTPUT is what --weights takes.

    Example: erfsfm-slam simulate worlds/0 --depth && erfsfm train --config tiny --dataset worlds/0 --output runs/toy
    """
    from erfsfm.config import load_experiment
    from erfsfm.training.run import depth_before_and_after
    from erfsfm.training.run import prepare as prepare_training
    from erfsfm.training.run import train as run_training

    changes = list(overrides or [])
    if seed is not None:
        changes.append(f"training.seed={seed}")
    experiment = load_experiment(config, changes).with_roots(dataset or [])
    command = shlex.join(["erfsfm", *sys.argv[1:]])
    with progress_bar() as progress:
        if prepare is not None:
            prepare_training(experiment, prepare, progress)
            typer.echo(f"train with: erfsfm train --config {config} --dataset {prepare}")
            return
        folder = run_training(experiment, output, resume, device, command, progress)
        typer.echo(f"weights in {folder}: use them with --weights {folder}")
        typer.echo(_how_good(folder))
        if experiment.initial_weights is None or experiment.data.validation_share == 0:
            return
        try:
            rows = depth_before_and_after(experiment, folder, device, progress)
        except ErfsfmError as error:
            logger.warning("depth before and after training was not compared: %s", error)
            return
    print_rows(rows, as_json=False)


def _how_good(folder: Path) -> str:
    """What the last validation measured, and the command that measures the weights on other data."""
    from erfsfm.model_record import read_record

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
    return f"{said}; errors on other data: erfsfm evaluate {kind} --weights {folder} --dataset {data}"


def train_fusion(
    dataset: Annotated[list[Path], typer.Option(help="a simulated world with depth maps; repeat")],
    validation: Annotated[list[Path], typer.Option(help="such a world, not trained on; repeat")],
    output: Annotated[Path, typer.Option(help="receives fusion.onnx")] = Path("runs/fusion"),
    weights: Weights = "default",
    samples: Annotated[int, typer.Option(min=8, help="to draw; a thousand takes 0.7 GB of memory")] = 4000,
    steps: Annotated[int, typer.Option(min=1, help="of optimisation")] = 6000,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Train the network that fuses learned and measured depth; OUTPUT is what depth.fusion of a run takes.

    Example: erfsfm train-fusion --dataset worlds/0 --validation worlds/1 --output runs/fusion
    """
    from erfsfm.training.fusion import train_fusion as run_training

    command = shlex.join(["erfsfm", *sys.argv[1:]])
    with progress_bar() as progress:
        metrics = run_training(dataset, validation, output, weights, samples, steps, seed, command, progress)
    print_rows([metrics], as_json)
    if not as_json:
        typer.echo(f"network in {output}: use it with --set depth.fusion={output}")
