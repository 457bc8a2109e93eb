"""The command ``erfsfm pack``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer


def pack(
    config: Annotated[str, typer.Option(help="of the training: a YAML file, or the name of a shipped configuration")],
    dataset: Annotated[
        list[Path] | None, typer.Option(help="KITTI odometry or raw root, image folder or video; repeat")
    ] = None,
    output: Annotated[Path, typer.Option(help="a new folder, --dataset of the training")] = Path("pack"),
    megabytes: Annotated[float, typer.Option(min=0.1, help="largest size of the pack")] = 60.0,
    quality: Annotated[int, typer.Option(min=1, max=100, help="of the JPEG images")] = 85,
    overrides: Annotated[list[str] | None, typer.Option("--set", help="section.key=value; repeat")] = None,
) -> None:
    """Pack the data of a training for another machine: frames at the networks' size, and what the teacher measured.

    Real recordings are packed whole, simulated ones shortened until all fits.

    Example: erfsfm pack --config lite0-gpu --dataset KITTI --dataset worlds --set teacher.cache=labels --output pack
    """
    from erfsfm.config import load_experiment
    from erfsfm.training.pack import TEACHER_FOLDER
    from erfsfm.training.pack import pack as run_packing

    experiment = load_experiment(config, list(overrides or [])).with_roots(dataset or [])
    done = run_packing(experiment, output, megabytes, quality, quiet=not sys.stderr.isatty())
    frames = done.real_frames + done.simulated_frames
    typer.echo(
        f"{done.size / 1e6:.1f} MB in {output}: {done.real_frames} real and {done.simulated_frames} simulated frames, "
        f"{done.image_bytes / frames / 1e3:.1f} kB each; {done.labels} labels"
        + (f", {done.label_bytes / done.labels / 1e3:.1f} kB each" if done.labels else "")
    )
    if done.frames_left_out:
        typer.echo(f"left out: {done.frames_left_out} simulated frames with {done.labels_left_out} labels")
    teacher = f" --set teacher.cache={output / TEACHER_FOLDER}" if done.labels else ""
    typer.echo(f"train with: erfsfm train --config {config} --dataset {output}{teacher}")
