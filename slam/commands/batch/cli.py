"""The verb ``batch`` of the command line."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from erfsfm.common.progress import progress_bar
from slam.commands.options import Config, Device, Overrides, Seed
from slam.runtime.errors import RunError, SlamError
from slam.runtime.storage.files import from_anywhere
from slam.runtime.terminal import print_table

verbs = typer.Typer()


@verbs.command()
def batch(
    drives: Annotated[Path, typer.Argument(help="a manifest (CSV), or a data set")],
    output: Annotated[Path, typer.Option(help="holds a run folder for each drive, and drives.csv")],
    sequence: Annotated[
        list[str] | None, typer.Option("--sequence", "-s", help="sequence of the data set; repeat")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="drives at a time on this machine")] = 1,
    scheduler: Annotated[str | None, typer.Option(help="address of a Dask scheduler in place of this machine")] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="threads of a drive; default: the cores of this machine by the workers")
    ] = None,
    memory: Annotated[float, typer.Option(min=0, help="GiB that a drive may use; 0: all (Linux)")] = 0.0,
    weights: Annotated[str | None, typer.Option(help="as for run")] = None,
    config: Config = None,
    overrides: Overrides = None,
    frames: Annotated[str | None, typer.Option(help="A:B of every drive")] = None,
    seed: Seed = 0,
    device: Device = "auto",
) -> None:
    """Many drives at once, each in a process of its own. Started again, it runs what is not whole.

    Example: erfsfm-slam batch drives.csv --workers 4 --output drives
    """
    from slam.commands.batch.cluster import workers as dask_workers
    from slam.commands.batch.execution import Limits, run_drives
    from slam.commands.batch.manifest import drives_of, require_known
    from slam.commands.batch.summary import CSV, check_output, summary_table, write_summary

    if memory and not Path("/proc/self/statm").exists():
        raise SlamError("--memory needs Linux: leave it out here")
    options = [word for value in overrides or [] for word in ("--set", _seen_from_here(value))]
    if weights is not None:
        options += ["--weights", from_anywhere(weights) if Path(weights, "model.yaml").is_file() else weights]
    if config is not None:
        options += ["--config", from_anywhere(config) if Path(config).is_file() else config]
    options += ["--frames", frames] if frames is not None else []
    options += ["--seed", str(seed), "--device", device]
    planned = drives_of(drives, sequence or ["all"], options)
    for drive in planned:
        require_known(drive)
    each = threads or (0 if scheduler else max((os.cpu_count() or 1) // workers, 1))
    check_output(output, planned)
    output.mkdir(parents=True, exist_ok=True)
    with dask_workers(min(workers, len(planned)), scheduler) as spread, progress_bar() as progress:
        outcomes = run_drives(planned, output, Limits(each, memory), spread, progress)
    write_summary(output, outcomes)
    print_table(summary_table(outcomes))
    kept = sum(outcome.status == "kept" for outcome in outcomes)
    failed = sum(outcome.status == "failed" for outcome in outcomes)
    typer.echo(f"{len(outcomes)} drives, {kept} of them whole before, {failed} failed: {output / CSV}")
    if failed:
        first = next(outcome for outcome in outcomes if outcome.status == "failed")
        rest = "; the others are whole" if failed < len(outcomes) else ""
        raise RunError(f"{failed} of {len(outcomes)} drives failed{rest}; {first.drive.name}: {first.reason}")


def _seen_from_here(override: str) -> str:
    """The path of ``depth.source`` holds in the folder of a drive, too."""
    kind, colon, path = override.partition(":")
    return f"{kind}:{from_anywhere(path)}" if kind.startswith("depth.source=") and colon else override
