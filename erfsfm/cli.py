"""The command line ``erfsfm``: train the networks, look at what they learned."""

from __future__ import annotations

import json
import logging
import os
import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from erfsfm.errors import ErfsfmError

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Self-supervised depth and ego-motion networks with wide receptive fields.",
)
evaluate_app = typer.Typer(no_args_is_help=True, help="Depth and pose errors of trained networks.")
app.add_typer(evaluate_app, name="evaluate")

Device = Annotated[Literal["auto", "cpu", "cuda"], typer.Option(help="where to compute")]
Seed = Annotated[int, typer.Option(help="seed of everything random")]
Weights = Annotated[str, typer.Option(help="a shipped name (default, sim) or a training output folder")]
Json = Annotated[bool, typer.Option("--json", help="print JSON instead of a table")]
Fidelity = Annotated[
    Literal["default", "paper"], typer.Option(help="paper: as the reference code does it, with its quirks")
]


@app.command()
def train(
    config: Annotated[str, typer.Option(help="a YAML file, or the name of a shipped configuration")],
    dataset: Annotated[
        list[Path] | None, typer.Option(help="KITTI odometry root, image folder or video; repeat")
    ] = None,
    output: Annotated[Path, typer.Option(help="receives weights, checkpoints and logs")] = Path("runs/train"),
    resume: Annotated[bool, typer.Option("--resume", help="go on from the last checkpoint in OUTPUT")] = False,
    overrides: Annotated[list[str] | None, typer.Option("--set", help="section.key=value; repeat")] = None,
    seed: Annotated[int | None, typer.Option(help="overrides training.seed")] = None,
    device: Device = "auto",
) -> None:
    """Train without labels; OUTPUT is what --weights takes.

    Example: erfsfm-slam simulate worlds/0 --depth && erfsfm train --config tiny --dataset worlds/0 --output runs/toy
    """
    from erfsfm.config import load_experiment
    from erfsfm.training.run import train as run_training

    changes = list(overrides or [])
    if seed is not None:
        changes.append(f"training.seed={seed}")
    experiment = load_experiment(config, changes)
    if dataset:
        roots = [*experiment.data.roots, *dataset]
        experiment = experiment.model_copy(update={"data": experiment.data.model_copy(update={"roots": roots})})
    command = shlex.join(["erfsfm", *sys.argv[1:]])
    folder = run_training(experiment, output, resume, device, command, quiet=not sys.stderr.isatty())
    typer.echo(f"weights in {folder}: use them with --weights {folder}")


@app.command()
def predict(
    images: Annotated[Path, typer.Argument(help="an image, or a folder of images")],
    weights: Weights = "default",
    output: Annotated[Path, typer.Option(help="receives one .npy and one .png a frame")] = Path("depth"),
    device: Device = "auto",
    seed: Seed = 0,
) -> None:
    """Depth of images: unscaled z-depth as .npy, and a coloured picture of disparity.

    Example: erfsfm predict drive/images --weights default --output depth
    """
    from erfsfm.data.recordings import image_files
    from erfsfm.errors import DataError
    from erfsfm.inference import DepthPosePredictor, colour_disparity, read_image, save_depth, save_image

    files = image_files(images) if images.is_dir() else (images,)
    if not files:
        raise DataError(f"{images} holds no png or jpg to predict from")
    if output.resolve() in {file.parent.resolve() for file in files}:
        raise DataError(f"{output} holds the images themselves: choose another --output, or they would be overwritten")
    predictor = DepthPosePredictor.from_weights(weights, device)
    output.mkdir(parents=True, exist_ok=True)
    for file in files:
        depth = predictor.depth(read_image(file))
        save_depth(output / f"{file.stem}.npy", depth)
        save_image(output / f"{file.stem}.png", colour_disparity(depth))
    typer.echo(f"depth of {len(files)} images in {output}")


@app.command()
def networks(
    fidelity: Fidelity = "default",
    width: Annotated[float, typer.Option(help="multiplies the channels")] = 1.0,
    sources: Annotated[int, typer.Option(help="source frames of the pose networks")] = 4,
    as_json: Json = False,
) -> None:
    """Every network: parameters, multiply-adds at 416x128, receptive field.

    Example: erfsfm networks --fidelity paper
    """
    from erfsfm.networks.presets import describe

    summaries = [asdict(summary) for summary in describe(fidelity, width, sources)]
    if as_json:
        typer.echo(json.dumps(summaries, indent=2))
        return
    typer.echo(f"{'network':24}{'parameters':>12}{'multiply-adds':>15}{'receptive field':>17}")
    for row in summaries:
        work = f"{row['multiply_adds'] / 1e9:.2f} G" if row["multiply_adds"] is not None else "impossible"
        typer.echo(f"{row['name']:24}{row['parameters']:>12,}{work:>15}{row['receptive_field']:>14} px")


@evaluate_app.command("depth")
def evaluate_depth(
    dataset: Annotated[Path, typer.Option(help="a root with true depth: erfsfm-slam simulate --depth")],
    weights: Weights = "default",
    allow_leak: Annotated[bool, typer.Option("--allow-leak", help="evaluate frames seen in training")] = False,
    device: Device = "auto",
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Median-scaled depth errors under 80 m, beside the data's own median depth map as a baseline.

    Example: erfsfm evaluate depth --weights sim --dataset worlds/600
    """
    from erfsfm.evaluation.protocols import depth_protocol
    from erfsfm.inference import DepthPosePredictor

    _print_result(depth_protocol(DepthPosePredictor.from_weights(weights, device), dataset, allow_leak), as_json)


@evaluate_app.command("pose")
def evaluate_pose(
    dataset: Annotated[Path, typer.Option(help="a KITTI odometry root with poses")],
    sequence: Annotated[list[str], typer.Option(help="sequence names; repeat")],
    weights: Weights = "default",
    fidelity: Fidelity = "default",
    allow_leak: Annotated[bool, typer.Option("--allow-leak", help="evaluate frames seen in training")] = False,
    device: Device = "auto",
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Five-frame snippet ATE and RE, beside a straight constant motion as a baseline.

    Example: erfsfm evaluate pose --weights default --dataset KITTI --sequence 09 --sequence 10
    """
    from erfsfm.evaluation.protocols import pose_protocol
    from erfsfm.inference import DepthPosePredictor

    predictor = DepthPosePredictor.from_weights(weights, device)
    _print_result(pose_protocol(predictor, dataset, sequence, fidelity, allow_leak), as_json)


def _print_result(rows: list[dict[str, Any]], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
        return
    for row in rows:
        typer.echo("  ".join(f"{k} {v:.4f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))


def main() -> None:
    """Run the command line: known errors become one line and exit code 1."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    try:
        app()
    except (ErfsfmError, OSError) as error:
        typer.echo(f"erfsfm: {error}", err=True)
        sys.exit(1)
    except KeyboardInterrupt:
        typer.echo("erfsfm: interrupted; what was written stays", err=True)
        sys.exit(1)
