"""Errors of trajectories or of whole runs against a truth, as a table, as JSON or as CSV."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np
import typer

from erfsfm.common.readers.numbering import in_order
from erfsfm.common.table import Table, csv_of
from slam.evaluation.mistakes import likely_mistakes
from slam.evaluation.trajectory import TrajectoryMetrics, evo_commands, exceeded, trajectory_metrics
from slam.formats.trajectory import Trajectory, associate, read_trajectory
from slam.results import tables
from slam.results.folder import RunFolder, check_replaced
from slam.runtime.errors import ConfigError, RunError, SlamError, TrajectoryError
from slam.runtime.files import REFERENCE, trajectory_file, write_atomically
from slam.sequences.recording import frame_range, read_stamps

logger = logging.getLogger(__name__)


def require_metrics(limits: Sequence[str]) -> None:
    """Refuse limits of metrics that there are not; ``typer.BadParameter``."""
    try:
        exceeded(TrajectoryMetrics.unknown(""), limits)
    except ConfigError as error:
        raise typer.BadParameter(str(error), param_hint="--fail-over") from error


def against_reference(
    paths: Sequence[str],
    reference: Path,
    frames: str | None,
    format: str,
    limits: Sequence[str],
    as_json: bool,
    csv: Path | None,
    times: Path | None = None,
) -> None:
    """Any number of trajectories against one truth, as a table of systems; `SlamError` where one is over its limit."""
    if csv is not None:
        check_replaced(csv, b"system,path")
    runs = compare(named_paths(paths), reference, format, frames, times)
    if csv is not None:
        write_atomically(csv, csv_of(dict(_flat(run.tree())) for run in runs), RunError)
    if as_json:
        typer.echo(json.dumps([run.tree() for run in runs], indent=2))
    else:
        notes = [tables.UNITS, *tables.missing_notes({run.system: run.errors for run in runs})]
        head = ["system", "poses", *tables.headers()]
        Table(head, list(_rows(runs)), f"Errors against {reference}", notes).print()
    broken = []
    for run in runs:
        broken += [f"{run.path}: {line}" for line in exceeded(run.errors, limits)]
    if broken:
        raise SlamError("; ".join(broken))


def of_runs(paths: Sequence[Path], as_json: bool) -> None:
    """Run folders side by side."""
    runs = [(folder.path, folder.metrics()) for folder in map(RunFolder.open, paths)]
    if as_json:
        typer.echo(json.dumps(tables.runs_json(runs), indent=2))
    else:
        tables.runs_table(runs).print()


def of_two(
    estimate: Path,
    reference: Path,
    format: str,
    limits: Sequence[str],
    as_json: bool,
    times: Path | None = None,
) -> None:
    """One trajectory against another under every alignment, with the commands of evo that give the same.

    Raises:
        SlamError: a file cannot be read, or an error is over its limit.
    """
    (run,) = compare([("", estimate)], reference, format, times=times)
    if as_json:
        typer.echo(run.errors.to_json())
    else:
        tables.alignments_table(run.errors, f"{estimate.name} against {reference.name}").print()
        both = {estimate: "optimised", reference: REFERENCE}
        # a run has each trajectory in both formats
        timed = (read_trajectory(path, format).timed for path in both if path.is_file())
        kind = "tum" if all(timed) else "kitti"
        files = [
            path / trajectory_file(name, kind) if path.is_dir() else path
            for path, name in both.items()
        ]
        typer.echo("\n".join(evo_commands(files[0], files[-1], format)))
    if broken := exceeded(run.errors, limits):
        raise SlamError("; ".join(broken))


@dataclass(frozen=True)
class SystemRun:
    """One trajectory of a system, the number of its poses that have a true one, and its errors."""

    system: str
    path: Path
    poses: int
    errors: TrajectoryMetrics

    def tree(self) -> dict[str, Any]:
        """For JSON: the system, the file, the number of compared poses, and T of ``metrics.json``."""
        return {
            "system": self.system,
            "path": str(self.path),
            "poses": self.poses,
        } | self.errors.tree()


def named_paths(words: Sequence[str]) -> list[tuple[str, Path]]:
    """Files and run folders with the names of their systems.

    Args:
        words: each a path, whose system has the name of the file or folder, or ``NAME=PATH``, where PATH may be a
            pattern (``orb=runs/orb_*.txt``); all paths of one NAME are of one system.
    """
    found: list[tuple[str, Path]] = []
    plain = []
    for word in words:
        name, _, pattern = word.rpartition("=")
        path = Path(word)
        if not name or path.exists():
            plain.append(path.resolve().name if path.is_dir() else path.stem)
            found.append((plain[-1], path))
            continue
        # brackets may be those of a name; Path.glob takes no whole path
        paths = [pattern] if Path(pattern).exists() else sorted(glob(pattern))  # noqa: PTH207
        if not paths:
            raise RunError(f"{word}: no file or folder is named {pattern}")
        found += [(name, Path(path)) for path in paths]
    return [(str(path) if plain.count(name) > 1 else name, path) for name, path in found]


def trajectory_at(
    path: Path, format: str = "auto", of_run: str = "optimised", times: Path | None = None
) -> Trajectory:
    """A trajectory file, at ``times`` where its rows have none, or one of the trajectories of a run folder."""
    if not path.is_dir():
        given = read_trajectory(path, format)
        if times is None or given.timed:
            return given
        numbers = given.frame_numbers
        frames = max(given.frame_count, int(numbers[-1]) + 1)
        stamps = read_stamps(times, in_order([path] * frames))[numbers]
        return Trajectory(stamps, given.T_world_camera)
    trajectory = RunFolder.open(path).trajectory(of_run)
    if trajectory is None:
        raise RunError(f"{path} has no {of_run} trajectory: give a trajectory file, or another run")
    return trajectory


def compare(
    paths: Sequence[tuple[str, Path]],
    reference: Path,
    format: str = "auto",
    frames: str | None = None,
    times: Path | None = None,
) -> list[SystemRun]:
    """Errors of trajectories against one reference.

    Args:
        paths: files or run folders by system (`named_paths`).
        reference: a trajectory file, or a run folder with a reference.
        format: of the files.
        frames: ``A:B`` of the reference, half-open; a file of B - A rows without frame numbers is of these frames.
        times: those of the rows of files without stamps, as KITTI's ``times.txt``.

    Raises:
        SlamError: a file cannot be read, or its poses do not belong to those of the reference.
    """
    truth = trajectory_at(reference, format, REFERENCE, times)
    chosen = None if frames is None else frame_range(frames, len(truth))
    runs = []
    for name, path in paths:
        estimate = trajectory_at(path, format, times=times)
        try:
            pair = associate(estimate, truth, chosen)
        except TrajectoryError as error:
            raise TrajectoryError(f"{path}: {error}") from error
        for mistake in likely_mistakes(estimate, truth, pair):
            line = f"{path}: {mistake}"
            logger.warning(line)
        runs.append(SystemRun(name, path, len(pair[0]), trajectory_metrics(*pair)))
    return runs


def _rows(runs: Sequence[SystemRun]) -> Iterator[list[str]]:
    """A row for each system; of several trajectories of one, the mean and the deviation of a sample."""
    for system in dict.fromkeys(run.system for run in runs):
        own = [run for run in runs if run.system == system]
        poses = "/".join(map(str, sorted({run.poses for run in own})))
        name = f"{system} ({len(own)} runs)" if len(own) > 1 else system
        yield [name, poses, *(_spread(column, own) for column in tables.COLUMNS)]


def _spread(column: tables.ErrorColumn, runs: Sequence[SystemRun]) -> str:
    """The number of one run; of several the mean and the deviation of those that have it."""
    numbers = (run.errors.at(column.path)[0] for run in runs)
    values = [number for number in numbers if number is not None]
    if len(values) < 2:
        return tables.written(values[0] if values else None, column.decimals)
    mean, deviation = float(np.mean(values)), float(np.std(values, ddof=1))
    return f"{tables.written(mean, column.decimals)} ± {tables.written(deviation, column.decimals)}"


def _flat(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers by their dotted paths, without reasons."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        elif not key.endswith("_reason"):
            yield prefix + key, value
