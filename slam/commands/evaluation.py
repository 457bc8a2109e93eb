"""The verb ``evaluate`` of the command line."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Annotated, Literal

import typer

from slam.commands.options import Json, UnusedDevice, UnusedSeed
from slam.runtime.errors import SlamError
from slam.runtime.terminal import print_table

logger = logging.getLogger(__name__)
verbs = typer.Typer()


@verbs.command()
def evaluate(
    paths: Annotated[
        list[str], typer.Argument(help="ESTIMATE REFERENCE (files or a run), or runs; with --reference any of both")
    ],
    reference: Annotated[Path | None, typer.Option(help="the truth: a trajectory file or a run folder")] = None,
    frames: Annotated[str | None, typer.Option(help="A:B of the reference, half-open")] = None,
    format: Annotated[Literal["auto", "kitti", "tum"], typer.Option(help="of the files")] = "auto",
    csv: Annotated[Path | None, typer.Option(help="all numbers, with --reference")] = None,
    fail_over: Annotated[list[str] | None, typer.Option(help="METRIC=VALUE: exit 1 if it is larger; repeat")] = None,
    as_json: Json = False,
    seed: UnusedSeed = 0,
    device: UnusedDevice = "auto",
) -> None:
    """Errors of trajectories or of whole runs.

    Of two trajectories, files or that of a run: all metrics under all alignments. Of run folders: their tables side by
    side. With --reference: one table of any number of files and runs. NAME=PATH names a system; of several with one
    NAME the table has mean and deviation.

    Example: erfsfm-slam evaluate ours=results/latest "orb=orb_*.txt" --reference poses/09.txt
    """
    if reference is not None:
        _compare(paths, reference, frames, format, fail_over or [], as_json, csv)
        return
    files = [Path(path) for path in paths]
    if frames or csv:
        raise typer.BadParameter("--frames and --csv need --reference FILE")
    if all(path.is_dir() for path in files):
        if fail_over:
            raise typer.BadParameter("a limit applies to trajectory files: give --reference", param_hint="--fail-over")
        _evaluate_runs(files, as_json)
    elif len(paths) == 2:
        missing = next((path for path in files if not path.exists()), None)
        if missing is not None:
            raise SlamError(f"{missing}: no such file or folder")
        _evaluate_files(files[0], files[1], format, fail_over or [], as_json)
    else:
        given = ", ".join(paths)
        raise typer.BadParameter(f"give two trajectory files, run folders that exist, or --reference FILE; got {given}")


def _compare(
    paths: list[str],
    reference: Path,
    frames: str | None,
    format: str,
    limits: list[str],
    as_json: bool,
    csv: Path | None,
) -> None:
    from slam.evaluation.trajectory import exceeded
    from slam.results.output_file import check_replaced
    from slam.results.systems import compare, named_paths, systems_table, write_csv

    if csv is not None:
        check_replaced(csv, {".csv": b"system,path"})
    runs = compare(named_paths(paths), reference, format, frames)
    if csv is not None:
        write_csv(runs, csv)
    if as_json:
        typer.echo(json.dumps([run.tree() for run in runs], indent=2))
    else:
        print_table(systems_table(runs, reference))
    broken = [f"{run.path}: {line}" for run in runs for line in exceeded(run.errors, limits)]
    if broken:
        raise SlamError("; ".join(broken))


def _evaluate_runs(paths: list[Path], as_json: bool) -> None:
    from slam.results.folder import RunFolder
    from slam.results.terminal_tables import comparison_json, comparison_table

    runs = [RunFolder.open(path) for path in paths]
    if as_json:
        typer.echo(json.dumps(comparison_json(runs), indent=2))
    else:
        print_table(comparison_table(runs))


def _evaluate_files(estimate: Path, reference: Path, format: str, limits: list[str], as_json: bool) -> None:
    from slam.evaluation.mistakes import likely_mistakes
    from slam.evaluation.trajectory import evo_commands, exceeded, trajectory_metrics
    from slam.formats.trajectory import associate
    from slam.results.systems import trajectory_at
    from slam.results.terminal_tables import metrics_table
    from slam.runtime.run_files import REFERENCE

    whole = trajectory_at(estimate, format), trajectory_at(reference, format, REFERENCE)
    pair = associate(*whole)
    metrics = trajectory_metrics(*pair)
    for line in likely_mistakes(*whole, pair):
        logger.warning(line)
    if as_json:
        typer.echo(metrics.to_json())
    else:
        print_table(metrics_table({estimate.name: metrics}, f"against {reference.name}"))
        kind = "tum" if all(each.timed for each in whole) else "kitti"
        names = (estimate, "trajectory_optimised"), (reference, REFERENCE)
        ours, theirs = (path / f"{name}.{kind}.txt" if path.is_dir() else path for path, name in names)
        for line in evo_commands(ours, theirs, format):
            typer.echo(line)
    broken = exceeded(metrics, limits)
    if broken:
        raise SlamError("; ".join(broken))
