"""Errors of trajectories or of whole runs, printed as a table or as JSON."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from pathlib import Path

import typer

from slam.evaluation.mistakes import likely_mistakes
from slam.evaluation.trajectory import evo_commands, exceeded, trajectory_metrics
from slam.formats.trajectory import associate
from slam.results.folder import RunFolder
from slam.results.output import check_replaced
from slam.results.systems import compare, named_paths, systems_table, trajectory_at, write_csv
from slam.results.tables import alignments_table, runs_json, runs_table
from slam.runtime.errors import SlamError
from slam.runtime.run_files import REFERENCE

logger = logging.getLogger(__name__)


def against_reference(
    paths: Sequence[str],
    reference: Path,
    frames: str | None,
    format: str,
    limits: Sequence[str],
    as_json: bool,
    csv: Path | None,
) -> None:
    """Any number of trajectories against one truth, as a table of systems.

    Raises:
        SlamError: a file cannot be read or written, or an error is over its limit.
    """
    if csv is not None:
        check_replaced(csv, {".csv": b"system,path"})
    runs = compare(named_paths(paths), reference, format, frames)
    if csv is not None:
        write_csv(runs, csv)
    if as_json:
        typer.echo(json.dumps([run.tree() for run in runs], indent=2))
    else:
        systems_table(runs, reference).print()
    _require([f"{run.path}: {line}" for run in runs for line in exceeded(run.errors, limits)])


def of_runs(paths: Sequence[Path], as_json: bool) -> None:
    """Run folders side by side.

    Raises:
        SlamError: one is none.
    """
    runs = [RunFolder.open(path) for path in paths]
    if as_json:
        typer.echo(json.dumps(runs_json(runs), indent=2))
    else:
        runs_table(runs).print()


def of_two(estimate: Path, reference: Path, format: str, limits: Sequence[str], as_json: bool) -> None:
    """One trajectory against another under every alignment, with the commands of evo that give the same.

    Raises:
        SlamError: a file cannot be read, or an error is over its limit.
    """
    missing = next((path for path in (estimate, reference) if not path.exists()), None)
    if missing is not None:
        raise SlamError(f"{missing}: no such file or folder")
    whole = trajectory_at(estimate, format), trajectory_at(reference, format, REFERENCE)
    pair = associate(*whole)
    metrics = trajectory_metrics(*pair)
    for line in likely_mistakes(*whole, pair):
        logger.warning(line)
    if as_json:
        typer.echo(metrics.to_json())
    else:
        alignments_table(metrics, f"{estimate.name} against {reference.name}").print()
        kind = "tum" if all(each.timed for each in whole) else "kitti"
        names = (estimate, "trajectory_optimised"), (reference, REFERENCE)
        ours, theirs = (path / f"{name}.{kind}.txt" if path.is_dir() else path for path, name in names)
        typer.echo("\n".join(evo_commands(ours, theirs, format)))
    _require(exceeded(metrics, limits))


def _require(broken: Sequence[str]) -> None:
    if broken:
        raise SlamError("; ".join(broken))
