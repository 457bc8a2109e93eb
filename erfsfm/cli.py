"""The command line ``erfsfm``: train, evaluate, inspect and convert the networks."""

from __future__ import annotations

import json
import logging
import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from erfsfm.cli_evaluate import evaluate_app
from erfsfm.cli_options import Device, Fidelity, Json, Seed, UnusedSeed, Weights
from erfsfm.cli_train import train, train_fusion
from erfsfm.common import command_line
from erfsfm.common.table import Table

logger = logging.getLogger(__name__)

app = command_line.application("erfsfm", "Self-supervised depth and ego-motion networks with wide receptive fields.")
app.add_typer(evaluate_app, name="evaluate")
app.command()(train)
app.command("train-fusion")(train_fusion)


@app.command()
def predict(
    images: Annotated[Path, typer.Argument(help="an image, or a folder of images")],
    weights: Weights = "default",
    output: Annotated[Path, typer.Option(help="receives one .npy and one .png a frame")] = Path("depth"),
    device: Device = "auto",
    seed: UnusedSeed = 0,
) -> None:
    """Depth of images: unscaled z-depth as .npy, and a coloured picture of disparity; unreadable ones are left out.

    Example: erfsfm predict drive/images --weights default --output depth
    """
    from erfsfm.common.errors import DataError
    from erfsfm.common.readers.images import list_images
    from erfsfm.inference import (
        DepthPosePredictor,
        colour_disparity,
        is_prediction,
        read_image,
        save_depth,
        save_image,
    )

    if output.is_file():
        raise DataError(f"{output} is a file: give a folder as --output")
    files = list_images(images) if images.is_dir() else [images]
    if not files:
        raise DataError(f"{images} holds no png or jpg to predict from")
    if output.resolve() in {file.parent.resolve() for file in files}:
        raise DataError(f"{output} holds the images themselves: choose another --output, or they would be overwritten")
    for file in files:
        depth_file = output / f"{file.stem}.npy"
        found = [path for path in (depth_file, depth_file.with_suffix(".png")) if path.exists()]
        if found and not is_prediction(depth_file):
            raise DataError(f"{found[0]} is no earlier prediction and would be replaced: choose another --output")
    predictor = DepthPosePredictor.from_weights(weights, device)
    unreadable = []
    for file in files:
        depth_file = output / f"{file.stem}.npy"
        try:
            image = read_image(file)
        except DataError as error:
            if depth_file.exists():
                raise DataError(
                    f"{error}; {depth_file} is of an earlier image: remove it, or restore the image"
                ) from error
            unreadable.append(str(error))
            continue
        output.mkdir(parents=True, exist_ok=True)
        depth = predictor.depth(image)
        save_depth(depth_file, depth)
        save_image(depth_file.with_suffix(".png"), colour_disparity(depth))
    if len(unreadable) == len(files):
        raise DataError(unreadable[0])
    if unreadable:
        logger.warning("%d of %d images are left out: %s", len(unreadable), len(files), unreadable[0])
    typer.echo(f"depth of {len(files) - len(unreadable)} images in {output}")


@app.command()
def networks(
    fidelity: Fidelity = "default",
    width: Annotated[float, typer.Option(help="multiplies the channels")] = 1.0,
    sources: Annotated[int, typer.Option(min=1, max=8, help="source frames of the pose networks")] = 4,
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
    rows = []
    for row in summaries:
        work = f"{row['multiply_adds'] / 1e9:.2f} G" if row["multiply_adds"] is not None else "impossible"
        rows.append([row["name"], f"{row['parameters']:,}", work, f"{row['receptive_field']} px"])
    Table(["network", "parameters", "multiply-adds", "receptive field"], rows).print()


@app.command("receptive-field")
def receptive_field(
    network: Annotated[list[str] | None, typer.Option(help="preset; repeat; default: all")] = None,
    output: Annotated[Path, typer.Option(help="the figure: png, pdf or svg")] = Path("receptive-field.png"),
    images: Annotated[
        Path | None, typer.Option(help="a folder, first five images used; default: a synthetic street")
    ] = None,
    weights: Annotated[str, typer.Option(help="learned weights for their own presets; none: all untrained")] = "none",
    fidelity: Fidelity = "default",
    offsets_px: Annotated[float, typer.Option(min=0, help="outward offset of deformable taps, pixels")] = 1.0,
    height: Annotated[int, typer.Option(min=48, help="size of the image, pixels")] = 128,
    width: Annotated[int, typer.Option(min=48, help="size of the image, pixels")] = 416,
    device: Device = "auto",
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Receptive fields: theoretical, and effective by gradients (the paper's figure 4).

    Example: erfsfm receptive-field --network posenet --network erf-posenet-dfc --weights default --output field.png
    """
    import torch

    from erfsfm.checkpoint import load_model
    from erfsfm.common.errors import DataError
    from erfsfm.common.figure_file import require_figure
    from erfsfm.common.readers.images import list_images, resize_image
    from erfsfm.inference import choose_device, read_image
    from erfsfm.networks.presets import PRESETS
    from erfsfm.receptive_field.figure import draw_fields
    from erfsfm.receptive_field.measure import field_table, measure_fields, street_snippet

    require_figure(output)
    if images is None:
        snippet = street_snippet(5, height, width)
    else:
        files = list_images(images)[:5] if images.is_dir() else []
        if len(files) < 5:
            raise DataError(f"--images needs a folder of five consecutive images; {images} has {len(files)}")
        snippet = [resize_image(read_image(file), height, width) for file in files]
    torch.manual_seed(seed)
    learned = None if weights == "none" else (weights, load_model(weights))
    every = [name for name, preset in PRESETS.items() if fidelity == "default" or preset.encoder == "paper"]
    rows = measure_fields(network or every, fidelity, snippet, offsets_px, learned, choose_device(device))
    output.parent.mkdir(parents=True, exist_ok=True)
    draw_fields(rows, snippet[2], output)
    if as_json:
        typer.echo(json.dumps([row.summary() for row in rows], indent=2))
        return
    field_table(rows).print()
    typer.echo(f"picture in {output}")


@app.command()
def convert(
    files: Annotated[list[Path], typer.Argument(help="a depth checkpoint, a pose checkpoint, or both: .pth.tar")],
    output: Annotated[Path, typer.Option(help="receives the weights; a folder for --weights")],
    dilated: Annotated[
        bool, typer.Option("--dilated", help="the pose network is the dilated one; not recorded in the file")
    ] = False,
    width: Annotated[int, typer.Option(min=32, help="size of the training images, pixels")] = 416,
    height: Annotated[int, typer.Option(min=32, help="size of the training images, pixels")] = 128,
    trained_on: Annotated[
        list[str] | None, typer.Option(help="recording seen in training, e.g. kitti_odometry/00; repeat")
    ] = None,
) -> None:
    """Convert weights of SfMLearner-PyTorch and ERF-SfMLearner; no code in the files is executed.

    Example: erfsfm convert dispnet_model_best.pth.tar exp_pose_model_best.pth.tar --output weights/old
    """
    from erfsfm.convert import convert as run_conversion

    command = shlex.join(["erfsfm", *sys.argv[1:]])
    for old in run_conversion(files, output, dilated, (height, width), trained_on or (), command):
        size = sum(value.numel() for value in old.tensors.values())
        typer.echo(f"{old.kind}: {old.preset}, {size:,} weights from {old.path}")
    if not trained_on:
        typer.echo("training data unknown: leaks cannot be detected (--trained-on names it)", err=True)
    typer.echo(f"weights in {output}: use them with --weights {output}")


@app.command()
def export(
    weights: Weights = "default",
    output: Annotated[Path, typer.Option(help="depth network's file; the pose network goes beside it")] = Path(
        "erfsfm.onnx"
    ),
    format_: Annotated[Literal["onnx"], typer.Option("--format", help="format of the files")] = "onnx",
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Both networks as ONNX, checked in onnxruntime: --output net.onnx writes net.onnx (depth) and net_pose.onnx.

    Example: erfsfm export --weights default --format onnx --output net.onnx
    """
    from erfsfm.checkpoint import load_model
    from erfsfm.export import export_onnx

    files = export_onnx(load_model(weights), output, seed)
    if as_json:
        typer.echo(json.dumps([asdict(file) | {"path": str(file.path)} for file in files], indent=2))
        return
    for file in files:
        typer.echo(f"{file.kind}: {file.preset} in {file.path}; differs from PyTorch by {file.difference:.1e}")


def main() -> None:
    """Run the command line: known errors become one line and exit code 1."""
    command_line.run(app, "erfsfm", logging.INFO)
