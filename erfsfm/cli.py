"""The command line ``erfsfm``: train, evaluate, inspect and convert the networks."""

from __future__ import annotations

import json
import logging
import shlex
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from erfsfm.common import command_line
from erfsfm.common.command_line import Device, Json, Overrides, Seed, UnusedSeed
from erfsfm.common.errors import ConfigError, DataError, ErfsfmError
from erfsfm.common.progress import progress_bar
from erfsfm.common.table import Table, table_of

logger = logging.getLogger(__name__)

app = command_line.application(
    "erfsfm", "Self-supervised depth and ego-motion networks with wide receptive fields."
)
evaluate_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Depth and pose errors of trained networks."
)
app.add_typer(evaluate_app, name="evaluate")

Weights = Annotated[
    str, typer.Option(help="a shipped name (default, sim) or a training output folder")
]
ManyWeights = Annotated[
    list[str],
    typer.Option(
        help="a shipped name (default, sim) or a training output folder; repeat to compare"
    ),
]
Fidelity = Annotated[
    Literal["default", "paper"], typer.Option(help="paper: exactly as the reference code")
]
AllowLeak = Annotated[bool, typer.Option("--allow-leak", help="evaluate frames seen in training")]


@app.command()
def train(
    config: Annotated[
        str, typer.Option(help="a YAML file, or the name of a shipped configuration")
    ],
    dataset: Annotated[
        list[Path] | None,
        typer.Option(
            help="KITTI odometry or raw root, image folder, video or prepared folder; repeat"
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(help="camera.yaml of images and videos, for that beside them; auto finds it"),
    ] = None,
    output: Annotated[Path, typer.Option(help="receives weights, checkpoints and logs")] = Path(
        "runs/train"
    ),
    prepare: Annotated[
        Path | None,
        typer.Option(
            help="write the frames, at the networks' size, and the labels to this folder, and stop: it is a "
            "--dataset for the same training elsewhere"
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="resume from the last checkpoint in OUTPUT")
    ] = False,
    overrides: Overrides = None,
    seed: Annotated[int | None, typer.Option(help="overrides training.seed")] = None,
    device: Device = "auto",
) -> None:
    """Train a depth and a pose network; OUTPUT is what --weights takes.

    Example: erfsfm-slam simulate worlds/0 --depth && erfsfm train --config tiny --dataset worlds/0 --output runs/toy
    """
    from erfsfm.config import UNTRAINED, load_experiment
    from erfsfm.training.output_folder import how_good
    from erfsfm.training.run import depth_before_and_after
    from erfsfm.training.run import prepare as prepare_training
    from erfsfm.training.run import train as run_training

    changes = list(overrides or [])
    if seed is not None:
        changes.append(f"training.seed={seed}")
    experiment = load_experiment(config, changes).with_roots(dataset or [])
    with progress_bar() as progress:
        if prepare is not None:
            prepare_training(experiment, prepare, progress, camera)
            typer.echo(f"train with: erfsfm train --config {config} --dataset {prepare}")
            return
        folder = run_training(experiment, output, resume, device, _command(), progress, camera)
        typer.echo(f"weights in {folder}: use them with --weights {folder}")
        typer.echo(how_good(folder))
        if experiment.initial_weights in UNTRAINED or experiment.data.validation_share == 0:
            return
        try:
            rows = depth_before_and_after(experiment, folder, device, progress, camera)
        except ErfsfmError as error:
            logger.warning("depth before and after training was not compared: %s", error)
            return
    print_rows(rows, as_json=False)


@app.command("train-fusion")
def train_fusion(
    dataset: Annotated[list[Path], typer.Option(help="a simulated world with depth maps; repeat")],
    validation: Annotated[list[Path], typer.Option(help="such a world, not trained on; repeat")],
    output: Annotated[Path, typer.Option(help="receives fusion.onnx")] = Path("runs/fusion"),
    weights: Weights = "default",
    samples: Annotated[
        int, typer.Option(min=8, help="to draw; a thousand takes 0.7 GB of memory")
    ] = 4000,
    steps: Annotated[
        int, typer.Option(min=0, help="of optimisation; 0 fits the sigma alone")
    ] = 6000,
    start: Annotated[
        str | None, typer.Option(help="begin with the network of default, or an output folder")
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Train the network that fuses learned and measured depth; OUTPUT is what depth.fusion of a run takes.

    Example: erfsfm train-fusion --dataset worlds/0 --validation worlds/1 --output runs/fusion
    """
    from erfsfm.training.fusion import train_fusion as run_training

    told = (weights, start), samples, steps, seed, _command()
    with progress_bar() as progress:
        metrics = run_training(dataset, validation, output, *told, progress)
    print_rows([metrics], as_json)
    if not as_json:
        typer.echo(f"network in {output}: use it with --set depth.fusion={output}")


@evaluate_app.command("depth")
def evaluate_depth(
    dataset: Annotated[
        list[Path],
        typer.Option(
            help="a root with depth_2, KITTI raw, or a folder of images/ and truth/; repeat"
        ),
    ],
    weights: ManyWeights = ["default"],  # noqa: B006
    truth: Annotated[
        Literal["measured", "many-views"],
        typer.Option(
            help="many-views: measured by optical flow at the poses of a run, for drives without true depth"
        ),
    ] = "measured",
    sequence: Annotated[
        list[str] | None,
        typer.Option(help="with many-views: recordings, or frames of one: 00[250:300]; repeat"),
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option(help="with many-views: folder that keeps poses and depth for the next time"),
    ] = None,
    refined: Annotated[
        bool, typer.Option("--refined", help="depth as a run makes it, in its metres: all frames")
    ] = False,
    split: Annotated[
        str | None,
        typer.Option(
            help="frames of KITTI raw: eigen, a YAML split, or a file of lines 'drive frame' or image paths"
        ),
    ] = None,
    fidelity: Fidelity = "default",
    allow_leak: AllowLeak = False,
    pictures: Annotated[
        Path | None,
        typer.Option(help="folder that receives a picture of each street: image, depths and truth"),
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="a file that receives the JSON as well")
    ] = None,
    device: Device = "auto",
    seed: UnusedSeed = 0,
    as_json: Json = False,
) -> None:
    """Depth errors under 80 m: Eigen's protocol with --split, else every fifth frame, and every street counts alike.

    Standard errors are those over streets. Several weights are compared by the ratio of their abs_rel to that of the
    first on each street, and by the geometric mean of the ratios. JSON has all errors. With --truth many-views no true
    depth is needed: static surfaces are measured from their neighbouring frames.

    Example: erfsfm evaluate depth --weights default --weights sim --dataset worlds --dataset KITTI_RAW --output d.json
    """
    from erfsfm.data.discovery import named_recordings
    from erfsfm.evaluation.depth_protocols import (
        depth_protocol,
        many_view_protocol,
        refined_protocol,
    )
    from erfsfm.evaluation.eigen import eigen_protocol
    from erfsfm.inference import DepthPosePredictor

    if truth == "many-views" and split is not None:
        raise ConfigError(
            "--truth many-views measures depth itself: leave --split out, name frames with --sequence"
        )
    if truth == "measured" and (sequence or cache):
        raise ConfigError("--sequence and --cache belong to --truth many-views")
    if fidelity == "paper" and split is None:
        raise ConfigError("--fidelity paper needs --split eigen or a file of frames of KITTI raw")
    if refined and (truth == "many-views" or split or pictures or len(weights) > 1):
        raise ConfigError("--refined takes one --weights and true depth: leave other options out")
    if (max(len(dataset), len(weights)) > 1 or pictures) and (
        truth == "many-views" or split is not None
    ):
        raise ConfigError(
            "--split and --truth many-views take one --dataset, one --weights, and no --pictures"
        )
    names = weights if len(weights) > 1 else ["networks"]
    networks = {
        name: DepthPosePredictor.from_weights(each, device) for name, each in zip(names, weights)
    }
    with progress_bar() as show:
        if truth == "many-views":
            parts = [
                part for name in sequence or [""] for part in named_recordings(dataset[0], name)
            ]
            rows = many_view_protocol(networks["networks"], parts, cache, allow_leak, show)
        elif refined:
            rows = refined_protocol(networks["networks"], weights[0], dataset, allow_leak, show)
        elif split is None:
            rows = depth_protocol(networks, dataset, allow_leak, show, pictures)
        else:
            rows = eigen_protocol(networks["networks"], dataset[0], split, fidelity, allow_leak)
    _show(rows, output, as_json)


def _show(rows: list[dict[str, Any]], output: Path | None, as_json: bool) -> None:
    """Write the rows, if a file is named, and print them."""
    from erfsfm.common.files import write_atomically
    from erfsfm.evaluation.depth_protocols import for_a_table

    if output is not None:
        write_atomically(output, json.dumps(rows, indent=2) + "\n")
    print_rows(rows if as_json else for_a_table(rows), as_json)


@evaluate_app.command("pose")
def evaluate_pose(
    dataset: Annotated[Path, typer.Option(help="a KITTI odometry root with poses")],
    sequence: Annotated[
        list[str], typer.Option(help="sequence names, or frames of one: 00[250:300]; repeat")
    ],
    weights: Weights = "default",
    fidelity: Fidelity = "default",
    allow_leak: AllowLeak = False,
    device: Device = "auto",
    seed: UnusedSeed = 0,
    as_json: Json = False,
) -> None:
    """Five-frame snippet ATE and RE, beside constant velocity straight ahead as a baseline.

    Example: erfsfm evaluate pose --weights default --dataset KITTI --sequence 09 --sequence 10
    """
    from erfsfm.evaluation.pose_protocols import pose_protocol
    from erfsfm.inference import DepthPosePredictor

    predictor = DepthPosePredictor.from_weights(weights, device)
    print_rows(pose_protocol(predictor, dataset, sequence, fidelity, allow_leak), as_json)


@app.command()
def predict(
    images: Annotated[Path, typer.Argument(help="an image, or a folder of images")],
    weights: Weights = "default",
    output: Annotated[Path, typer.Option(help="receives one .npy and one .png a frame")] = Path(
        "depth"
    ),
    device: Device = "auto",
    seed: UnusedSeed = 0,
) -> None:
    """Depth of images: unscaled z-depth as .npy, and a coloured picture of disparity; unreadable ones are left out.

    Example: erfsfm predict drive/images --weights default --output depth
    """
    import cv2
    import numpy as np

    from erfsfm.common.files import write_atomically
    from erfsfm.common.readers.images import images_at, read_image, report_unreadable
    from erfsfm.inference import DepthPosePredictor, colour_disparity

    if output.is_file():
        raise DataError(f"{output} is a file: give a folder as --output")
    files = images_at(images)
    if output.resolve() in {file.parent.resolve() for file in files}:
        raise DataError(
            f"{output} holds the images themselves: choose another --output, or they would be overwritten"
        )
    for file in files:
        depth_file = output / f"{file.stem}.npy"
        found = [path for path in (depth_file, depth_file.with_suffix(".png")) if path.exists()]
        if len(found) == 1:
            raise DataError(
                f"{found[0]} is no earlier prediction and would be replaced: choose another --output"
            )
    predictor = DepthPosePredictor.from_weights(weights, device)
    unreadable = []
    for file in files:
        depth_file = output / f"{file.stem}.npy"
        try:
            image = read_image(file)
        except DataError as error:
            unreadable.append(str(error))
            continue
        output.mkdir(parents=True, exist_ok=True)
        depth = predictor.depth(image)
        write_atomically(depth_file, partial(np.save, arr=depth))
        picture = cv2.imencode(".png", colour_disparity(depth)[..., ::-1])[1]
        write_atomically(depth_file.with_suffix(".png"), bytes(picture))
    report_unreadable(unreadable, len(files), "images")
    typer.echo(f"depth of {len(files) - len(unreadable)} images in {output}")


@app.command()
def networks(
    fidelity: Fidelity = "default",
    width: Annotated[float, typer.Option(help="multiplies the channels")] = 1.0,
    sources: Annotated[
        int, typer.Option(min=1, max=8, help="source frames of the pose networks")
    ] = 4,
    as_json: Json = False,
) -> None:
    """Every network: parameters, multiply-adds at 416x128, receptive field.

    Example: erfsfm networks --fidelity paper
    """
    from erfsfm.networks.presets import describe

    summaries = describe(fidelity, width, sources)
    if as_json:
        return print_rows(summaries, as_json)
    rows = []
    for row in summaries:
        work = (
            f"{row['multiply_adds'] / 1e9:.2f} G"
            if row["multiply_adds"] is not None
            else "impossible"
        )
        rows.append([row["name"], f"{row['parameters']:,}", work, f"{row['receptive_field']} px"])
    Table(["network", "parameters", "multiply-adds", "receptive field"], rows).print()


@app.command("receptive-field")
def receptive_field(
    network: Annotated[list[str] | None, typer.Option(help="preset; repeat; default: all")] = None,
    output: Annotated[Path, typer.Option(help="the figure: png, pdf or svg")] = Path(
        "receptive-field.png"
    ),
    images: Annotated[
        Path | None,
        typer.Option(help="a folder, first five images used; default: a synthetic street"),
    ] = None,
    weights: Annotated[
        str, typer.Option(help="learned weights for their own presets; none: all untrained")
    ] = "none",
    fidelity: Fidelity = "default",
    offsets_px: Annotated[
        float, typer.Option(min=0, help="outward offset of deformable taps, pixels")
    ] = 1.0,
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
    from erfsfm.common.files import require_figure
    from erfsfm.common.readers.images import images_at, resize_image
    from erfsfm.inference import choose_device, read_image
    from erfsfm.networks.presets import PRESETS
    from erfsfm.receptive_field import draw_fields, field_table, measure_fields, street_snippet

    require_figure(output)
    if images is None:
        snippet = street_snippet(5, height, width)
    else:
        files = images_at(images)[:5]
        if len(files) < 5:
            raise DataError(
                f"--images needs a folder of five consecutive images; {images} has {len(files)}"
            )
        snippet = [resize_image(read_image(file), height, width) for file in files]
    torch.manual_seed(seed)
    learned = None if weights == "none" else (weights, load_model(weights))
    every = [
        name
        for name, preset in PRESETS.items()
        if fidelity == "default" or preset.encoder == "paper"
    ]
    rows = measure_fields(
        network or every, fidelity, snippet, offsets_px, learned, choose_device(device)
    )
    output.parent.mkdir(parents=True, exist_ok=True)
    draw_fields(rows, snippet[2], output)
    if as_json:
        return print_rows([row.summary for row in rows], as_json)
    field_table(rows).print()
    typer.echo(f"picture in {output}")


@app.command()
def convert(
    files: Annotated[
        list[Path], typer.Argument(help="a depth checkpoint, a pose checkpoint, or both: .pth.tar")
    ],
    output: Annotated[Path, typer.Option(help="receives the weights; a folder for --weights")],
    dilated: Annotated[
        bool,
        typer.Option(
            "--dilated", help="the pose network is the dilated one; not recorded in the file"
        ),
    ] = False,
    width: Annotated[int, typer.Option(min=32, help="size of the training images, pixels")] = 416,
    height: Annotated[int, typer.Option(min=32, help="size of the training images, pixels")] = 128,
    trained_on: Annotated[
        list[str] | None,
        typer.Option(help="recording seen in training, e.g. kitti_odometry/00; repeat"),
    ] = None,
) -> None:
    """Convert weights of SfMLearner-PyTorch and ERF-SfMLearner; no code in the files is executed.

    Example: erfsfm convert dispnet_model_best.pth.tar exp_pose_model_best.pth.tar --output weights/old
    """
    from erfsfm.convert import convert as run_conversion

    for old in run_conversion(
        files, output, dilated, (height, width), trained_on or (), _command()
    ):
        size = sum(value.numel() for value in old.tensors.values())
        typer.echo(f"{old.kind}: {old.preset}, {size:,} weights from {old.path}")
    if not trained_on:
        typer.echo(
            "training data unknown: leaks cannot be detected (--trained-on names it)", err=True
        )
    typer.echo(f"weights in {output}: use them with --weights {output}")


@app.command()
def export(
    weights: Weights = "default",
    output: Annotated[
        Path, typer.Option(help="depth network's file; the pose network goes beside it")
    ] = Path("erfsfm.onnx"),
    format_: Annotated[
        Literal["onnx"], typer.Option("--format", help="format of the files")
    ] = "onnx",
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
        return print_rows([asdict(file) | {"path": str(file.path)} for file in files], as_json)
    for file in files:
        typer.echo(
            f"{file.kind}: {file.preset} in {file.path}; differs from PyTorch by {file.difference:.1e}"
        )


def print_rows(rows: list[dict[str, Any]], as_json: bool) -> None:
    """A table with a row a line and the keys as its head; or JSON."""
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
    else:
        table_of(rows).print()


def _command() -> str:
    return shlex.join(["erfsfm", *sys.argv[1:]])


def main() -> None:
    """Run the command line: known errors become one line and exit code 1."""
    command_line.run(app, "erfsfm", logging.INFO)
