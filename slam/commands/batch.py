"""Many drives, of a manifest or of a data set, each in a process of its own, and one table of how they ended."""

from __future__ import annotations

import csv
import fcntl
import io
import logging
import os
import re
import runpy
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from erfsfm.common.errors import one_line
from erfsfm.common.files import read_text, refuse_foreign
from erfsfm.common.processes import slam_process
from erfsfm.common.progress import Progress
from erfsfm.common.readers.frame_range import EVERYTHING
from erfsfm.common.table import Table, csv_of
from erfsfm.inference import record_of_whole_weights
from slam.config.sections import load_config
from slam.results.folder import RunFolder
from slam.results.tables import written
from slam.results.verdict import verdict
from slam.runtime.errors import RunError, SequenceError, SlamError
from slam.runtime.files import from_anywhere, source_from_anywhere, write_atomically
from slam.runtime.imports import import_extra
from slam.sequences.catalogue import sequence_kinds
from slam.sequences.recording import frame_range

CSV = "drives.csv"
_MANIFEST = ".csv"
_KEYS = ("name", "dataset", "sequence", "camera", "options")
_LOG_BEGIN = "erfsfm-slam run "  # a log begins with the command
_CSV_BEGIN = "drive,status,reason"
_ERRORS = "trajectories.optimised.align"
# columns of drives.csv, and their paths in the metrics; the doubts are those of the verdict
_COLUMNS = {
    "sequence": "sequence.name",
    "frames": "sequence.frames",
    "length_m": "sequence.length_m",
    "scale": "scale.mode",
    "unit": "unit",
    "ate_6dof_m": f"{_ERRORS}.6dof.ate_rmse_m",
    "ate_7dof_m": f"{_ERRORS}.7dof.ate_rmse_m",
    "t_rel_percent": f"{_ERRORS}.7dof.t_rel_percent",
    "r_rel_deg_per_100m": f"{_ERRORS}.7dof.r_rel_deg_per_100m",
    "confidence": "confidence.run",
    "path": "motion.path",
    "mean_speed": "motion.mean_speed",
    "top_speed": "motion.top_speed",
    "doubts": "",
    "interpolated_frames": "sequence.bridged_frames",
    "loops": "loops.accepted",
    "map_triangles": "map.triangles",
    "leak": "provenance.leak",
    "seconds": "timing.seconds_total",
    "frames_per_second": "timing.frames_per_second",
    "peak_rss_mb": "timing.peak_rss_mb",
}
# those on a terminal, and their decimals
_SHOWN = {
    "frames": 0,
    "length_m": 0,
    "unit": 0,
    "ate_6dof_m": 3,
    "ate_7dof_m": 3,
    "t_rel_percent": 2,
}
_SHOWN |= {"confidence": 2, "seconds": 1}


@dataclass(frozen=True)
class Drive:
    """One run: ``name`` of its folder, and ``arguments`` of ``erfsfm-slam run`` without ``--output``.

    Relative paths are seen from ``folder``.
    """

    name: str
    folder: Path
    arguments: tuple[str, ...]


@dataclass(frozen=True)
class Outcome:
    """How a drive ended: its run is whole, or was whole before and kept, or failed with a reason."""

    drive: Drive
    folder: Path
    status: Literal["whole", "kept", "failed"]
    reason: str = ""


def options_of_drives(
    weights: str | None,
    config: str | None,
    overrides: Sequence[str],
    frames: str | None,
    seed: int,
    device: str,
) -> list[str]:
    """Options of ``run`` for all drives, with paths that hold in the folder of each."""
    load_config(config, overrides)
    record_of_whole_weights(weights or "default")
    frame_range(frames or ":", EVERYTHING)
    words = []
    for override in overrides:
        key, equals, value = override.partition("=")
        words += [
            "--set",
            key + equals + (source_from_anywhere(value) if key == "depth.source" else value),
        ]
    if weights is not None:
        words += [
            "--weights",
            from_anywhere(weights) if Path(weights, "model.yaml").is_file() else weights,
        ]
    if config is not None:
        words += ["--config", from_anywhere(config) if Path(config).is_file() else config]
    if frames is not None:
        words += ["--frames", frames]
    return [*words, "--seed", str(seed), "--device", device]


def drives_of(
    manifest_or_root: Path, sequences: Sequence[str], options: Sequence[str]
) -> list[Drive]:
    """The drives of a manifest, or the named sequences of a data set, ``all`` of them every one.

    These ``options`` of ``run`` are for all drives; those of a manifest come after them.
    """
    path = manifest_or_root
    if path.suffix.lower() != _MANIFEST or path.is_dir():
        rows = _rows_of_data_set(path, sequences)
    elif list(sequences) == ["all"]:
        rows = _manifest(path)
    else:
        raise SequenceError(f"{path} names its sequences itself: leave out --sequence")
    return _named(_drive(row, path, number, options) for number, row in enumerate(rows, 1))


def run_drives(
    drives: Sequence[Drive],
    output: Path,
    count: int,
    scheduler: str | None,
    progress: Progress,
    threads: int | None = None,
    memory_gib: float = 0.0,
) -> list[Outcome]:
    """Run drives, and write ``drives.csv``; one outcome a drive, in their order.

    Args:
        drives: to run; those that are whole there are kept.
        output: folder of their run folders.
        count: drives at a time on this machine.
        scheduler: address of a Dask scheduler in place of this machine.
        progress: is told how many have ended.
        threads: of a drive; None for the cores of this machine by the workers.
        memory_gib: that a drive may use; 0 for all.

    Raises:
        SlamError: a folder with files of others, or no such scheduler.
    """
    check_output(output, drives)
    output.mkdir(parents=True, exist_ok=True)
    threads = threads or (0 if scheduler else max((os.cpu_count() or 1) // count, 1))
    work = partial(run_drive, output=output.absolute(), threads=threads, memory_gib=memory_gib)
    outcomes: dict[str, Outcome] = {}
    progress("drives", 0, len(drives))
    for drive, result in spread(work, drives, min(count, len(drives)), scheduler):
        if not isinstance(result, Outcome):
            reason = one_line(f"{type(result).__name__}: {result}")
            result = Outcome(drive, output / drive.name, "failed", reason)
        outcomes[drive.name] = result
        progress("drives", len(outcomes), len(drives))
    ordered = [outcomes[drive.name] for drive in drives]
    rows = list(map(_row, ordered))
    if (output / CSV).exists():  # an earlier batch may have had other drives
        names, before = {drive.name for drive in drives}, io.StringIO(read_text(output / CSV))
        rows = [row for row in csv.DictReader(before) if row["drive"] not in names] + rows
    write_atomically(output / CSV, csv_of(rows), RunError)
    return ordered


def spread(
    work: Callable[[Drive], Outcome],
    drives: Sequence[Drive],
    count: int = 1,
    scheduler: str | None = None,
) -> Iterator[tuple[Drive, Outcome | BaseException]]:
    """Each drive with its result, as they end; the result of work that fails is its exception.

    One worker works here, without Dask. Drives of a worker that dies are given to another.
    """
    if count == 1 and scheduler is None:
        for drive in drives:
            try:
                yield drive, work(drive)
            except Exception as error:
                yield drive, error
        return
    (distributed,) = import_extra("cluster")
    # memory is that of each drive's process, whose limit is not Dask's
    local = {
        "n_workers": count,
        "threads_per_worker": 1,
        "dashboard_address": ":0",
        "memory_limit": None,
        "silence_logs": logging.CRITICAL,
    }
    try:
        there = {"address": scheduler, "timeout": "10s"}
        client = distributed.Client(**there if scheduler else local)
    except (OSError, ValueError) as error:
        raise SlamError(f"no Dask scheduler answers at {scheduler}: {error}") from error
    with client:
        futures = client.map(work, drives, pure=False)
        drive_of = dict(zip(futures, drives, strict=True))
        for future in distributed.as_completed(futures):
            yield drive_of[future], future.exception() or future.result()


def run_drive(drive: Drive, output: Path, threads: int = 0, memory_gib: float = 0.0) -> Outcome:
    """Run one drive to ``output/<name>``, unless the same command left a whole run there."""
    folder = output / drive.name
    arguments = ["run", *drive.arguments, "--output", str(folder)]
    if _is_whole(folder, arguments):
        return Outcome(drive, folder, "kept")
    output.mkdir(parents=True, exist_ok=True)
    log = output / f"{drive.name}.log"
    log.write_text(shlex.join(["erfsfm-slam", *arguments]) + "\n", encoding="utf-8")
    program = ("slam.commands.batch", str(output / f".{drive.name}.lock"))
    reason = slam_process(arguments, drive.folder, log, threads, memory_gib, program)
    if not reason and not _is_whole(folder, arguments):
        reason = "it ended well and left no whole run: leave out options that only ask something"
    return Outcome(drive, folder, "failed" if reason else "whole", reason)


def check_output(output: Path, drives: Sequence[Drive]) -> None:
    """Check that a batch of these drives may be written to a folder."""
    if output.exists() and not output.is_dir():
        raise RunError(f"{output} is a file: give a folder as --output")
    if CSV in {drive.name for drive in drives}:
        raise RunError(
            f"a drive is named {CSV}, as a file of the batch: give it another name in the manifest"
        )
    refuse_foreign([output / CSV], _CSV_BEGIN, RunError)
    for drive in drives:
        refuse_foreign([output / f"{drive.name}.log"], _LOG_BEGIN, RunError)


def summary_table(outcomes: Sequence[Outcome]) -> Table:
    """The main numbers of the runs that are whole, and why others failed."""
    rows, notes = [], []
    for outcome in outcomes:
        if outcome.status == "failed":
            notes.append(f"{outcome.drive.name} failed: {outcome.reason}")
            continue
        row = _row(outcome)
        numbers = (written(row[name], decimals) for name, decimals in _SHOWN.items())
        rows.append([row["drive"], row["status"], *numbers])
    return Table(
        ["drive", "status", *(name.replace("_", "\n", 1) for name in _SHOWN)], rows, notes=notes
    )


def _rows_of_data_set(root: Path, sequences: Sequence[str]) -> list[dict[str, str]]:
    """The rows of a manifest of the same drives."""
    names = list(sequence_kinds(root))
    if not names:
        raise SequenceError(f"{root} is no manifest ({_MANIFEST}) and holds no sequences")
    for name in sequences:
        if name not in ("all", *names):
            raise SequenceError(f"{root} has no sequence {name}: it has {', '.join(names)}")
    root = root.absolute() if root.exists() else root  # KITTI may be named by the environment alone
    chosen = names if "all" in sequences else sequences
    return [{"dataset": str(root), "sequence": name} for name in chosen]


def _manifest(path: Path) -> list[dict[str, str]]:
    try:
        lines = io.StringIO(read_text(path), newline="")
        rows = []
        for row in csv.DictReader(lines, skipinitialspace=True):
            rows.append({key: word for key, word in row.items() if word})
    except FileNotFoundError as error:
        raise SequenceError(f"no manifest {path}: check the path") from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SequenceError(
            f"the manifest {path} cannot be read: {getattr(error, 'strerror', error)}"
        ) from error
    if not rows:
        raise SequenceError(f"{path} names no drive: give rows of {', '.join(_KEYS)}")
    given = [row["name"] for row in rows if "name" in row]
    for name in given:
        if given.count(name) > 1:
            raise SequenceError(f"{path}: two drives are named {name}: choose other names")
    return rows


def _drive(row: dict[str, str], path: Path, number: int, options: Sequence[str]) -> Drive:
    unknown = [str(key) for key in row if key not in _KEYS]
    if unknown or "dataset" not in row:
        problem = f"{unknown[0]!r} is no key" if unknown else "dataset is missing"
        raise SequenceError(f"{path}, drive {number}: {problem}; the keys are {', '.join(_KEYS)}")
    try:
        own = shlex.split(row.get("options", ""))
    except ValueError as error:
        raise SequenceError(
            f"{path}, drive {number}: options are not understood ({error}): write them as on a command line"
        ) from error
    named = []
    for key in ("dataset", "sequence", "camera"):
        if key in row:
            named += [f"--{key}", row[key]]
    name = row.get("name") or row.get("sequence") or Path(row["dataset"]).stem
    return Drive(name, path.absolute().parent, (*named, *options, *own))


def _named(drives: Iterable[Drive]) -> list[Drive]:
    """Drives with names for folders; a repeated one is numbered."""
    found: dict[str, Drive] = {}
    for drive in drives:
        name = re.sub(r"[^\w.-]+", "-", drive.name).strip("-.") or "drive"
        number, unique = 1, name
        while unique in found:
            number += 1
            unique = f"{name}-{number}"
        found[unique] = replace(drive, name=unique)
    return list(found.values())


def _is_whole(folder: Path, arguments: list[str]) -> bool:
    """Whether a folder holds the whole run of this command."""
    try:
        metrics = RunFolder(folder).metrics()
    except SlamError:
        return False
    return metrics.status == "ok" and metrics.provenance.command == shlex.join(
        ["erfsfm-slam", *arguments]
    )


def _row(outcome: Outcome) -> dict[str, Any]:
    row: dict[str, Any] = {
        "drive": outcome.drive.name,
        "status": outcome.status,
        "reason": outcome.reason,
        **dict.fromkeys(_COLUMNS),
    }
    if outcome.status == "failed":
        return row
    metrics = RunFolder(outcome.folder).metrics()
    row |= {name: metrics.at(path)[0] for name, path in _COLUMNS.items() if path}
    if (said := verdict(metrics)) is not None:
        row["doubts"] = "; ".join(said.doubts)
    return row if metrics.is_metric else row | {"ate_6dof_m": None}


def _end_with_the_worker() -> None:
    while os.read(0, 1024):  # not sys.stdin, which Python cannot close under a reader as it exits
        pass
    os.kill(os.getpid(), signal.SIGTERM)


# LOCK run ...: a drive, which ends when its standard input does; no two to one folder
if __name__ == "__main__":
    lock = Path(sys.argv.pop(1)).open("w", encoding="utf-8")  # noqa: SIM115 - held until the process ends
    fcntl.flock(lock, fcntl.LOCK_EX)
    threading.Thread(target=_end_with_the_worker, daemon=True).start()
    runpy.run_module("slam", run_name="__main__", alter_sys=True)
