"""The command ``erfsfm pack``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from erfsfm.config import ExperimentConfig


def pack(
    config: Annotated[str, typer.Option(help="configuration of the training: a YAML file or a shipped name")],
    dataset: Annotated[
        list[Path] | None, typer.Option(help="KITTI odometry or raw root, image folder or video; repeat")
    ] = None,
    output: Annotated[Path, typer.Option(help="a new folder, --dataset of the training")] = Path("pack"),
    megabytes: Annotated[float, typer.Option(min=0.1, help="largest size of the pack, if it is not in shards")] = 60.0,
    shard_megabytes: Annotated[
        float | None, typer.Option(min=0.1, help="write tar files of at most this size, as many as all the data need")
    ] = None,
    quality: Annotated[int, typer.Option(min=1, max=100, help="quality of the JPEG images")] = 85,
    overrides: Annotated[list[str] | None, typer.Option("--set", help="section.key=value; repeat")] = None,
) -> None:
    """Pack the data of a training for another machine: frames at the networks' size, and what the teacher measured.

    Real recordings are packed whole, simulated ones shortened until all fits. With --shard-megabytes all is packed,
    into tar files that training reads one after the other, also over HTTP.

    Example: erfsfm pack --config default-gpu --dataset KITTI --dataset worlds --set teacher.cache=labels --output pack
    """
    from erfsfm.config import load_experiment
    from erfsfm.training.pack import TEACHER_FOLDER
    from erfsfm.training.pack import pack as run_packing

    experiment = load_experiment(config, list(overrides or [])).with_roots(dataset or [])
    if shard_megabytes is not None:
        _pack_shards(experiment, output, shard_megabytes, quality)
        typer.echo(f"train with: erfsfm train --config {config} --dataset {output}")
        return
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


def _pack_shards(experiment: ExperimentConfig, output: Path, megabytes: float, quality: int) -> None:
    from erfsfm.training.shard_pack import pack_shards

    done = pack_shards(experiment, output, megabytes, quality, quiet=not sys.stderr.isatty())
    typer.echo(
        f"{done.size / 1e6:.1f} MB in {output}: {done.files} shards with {done.frames} frames and {done.labels} labels"
    )
