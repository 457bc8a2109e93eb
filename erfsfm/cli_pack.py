"""The command ``erfsfm pack``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer


def pack(
    config: Annotated[str, typer.Option(help="configuration of the training: a YAML file or a shipped name")],
    dataset: Annotated[
        list[Path] | None, typer.Option(help="KITTI odometry or raw root, image folder or video; repeat")
    ] = None,
    output: Annotated[Path, typer.Option(help="a new folder, --dataset of the training")] = Path("pack"),
    shard_megabytes: Annotated[
        float, typer.Option(min=0.1, help="largest size of a tar file; training needs one for each loader process")
    ] = 4.0,
    quality: Annotated[int, typer.Option(min=1, max=100, help="quality of the JPEG images")] = 85,
    overrides: Annotated[list[str] | None, typer.Option("--set", help="section.key=value; repeat")] = None,
) -> None:
    """Pack the data of a training for another machine: frames at the networks' size, and what the teacher measured.

    All of it goes to tar files that training reads one after the other, also over HTTP.

    Example: erfsfm pack --config default-gpu --dataset KITTI --dataset worlds --set teacher.cache=labels --output pack
    """
    from erfsfm.config import load_experiment
    from erfsfm.training.pack import pack as run_packing

    experiment = load_experiment(config, list(overrides or [])).with_roots(dataset or [])
    done = run_packing(experiment, output, shard_megabytes, quality, quiet=not sys.stderr.isatty())
    typer.echo(
        f"{done.size / 1e6:.1f} MB in {output}: {done.shards} shards with {done.frames} frames and {done.labels} labels"
    )
    typer.echo(f"train with: erfsfm train --config {config} --dataset {output}")
