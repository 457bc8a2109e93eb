"""Runs, each in a process of its own, one after another or through Dask, and their results."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from benchmarking import plan
from benchmarking.plan import BenchmarkSequence, Job

from erfsfm.common.processes import slam_process
from slam.commands import cluster
from slam.commands.cluster import Spread
from slam.geometry.se3 import FloatArray, invert, rotation_angle
from slam.results.folder import RunFolder
from slam.results.metrics import LoopsFile, Metrics
from slam.runtime.run_files import GRAPH, LOOPS, MAP_CLOUD, MAP_MESH, METRICS, PLACES
from slam.runtime.storage.files import write_atomically

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("erfsfm", "slam", "configs")  # folders that results depend on
BULKY = (MAP_MESH, MAP_CLOUD, PLACES, GRAPH)  # removed after a run: no table reads them
FALSE_M, FALSE_DEG = 2.0, 5.0  # a loop with a larger error is false


@dataclass(frozen=True)
class JobResult:
    """The metrics of a job, or the reason of its failure; seconds of the whole command, load of the machine before."""

    job: Job
    metrics: Metrics
    commit: str
    reason: str = ""
    seconds: float | None = None
    load: float | None = None


def simulate(drive: BenchmarkSequence) -> None:
    """Simulate a world where it is missing; `measured` checks that it was made."""
    if not drive.root.exists():
        slam_process(["simulate", str(drive.root), *drive.simulate])


def perform(job: Job) -> None:
    """Run a job and write ``record.json`` to its folder, unless the same job was successful before."""
    if is_done(job):
        return
    shutil.rmtree(job.place, ignore_errors=True)
    job.place.mkdir(parents=True)
    record = {"identity": _identity(job), "load": os.getloadavg()[0]}
    start = time.perf_counter()
    reason = slam_process(job.arguments)
    record |= {"seconds": time.perf_counter() - start, "reason": reason}
    for name in BULKY:
        (job.place / "run" / name).unlink(missing_ok=True)
    write_atomically(job.place / "record.json", lambda path: path.write_text(json.dumps(record, indent=2)))


def is_done(job: Job) -> bool:
    """Whether the same job was successful before."""
    kept = _read(job.place / "record.json")
    return kept.get("identity") == _identity(job) and not _read_result(job, kept).reason


def _identity(job: Job) -> dict[str, Any]:
    return {"arguments": job.arguments, "commit": revision()}


def job_result(job: Job) -> JobResult:
    """The result of a job that was performed."""
    return _read_result(job, _read(job.place / "record.json"))


def _read_result(job: Job, record: Mapping[str, Any]) -> JobResult:
    commit, file = record.get("identity", {}).get("commit", ""), job.place / "run" / METRICS
    metrics = Metrics.read(file) if file.is_file() else Metrics()
    reason = metrics.failure or record.get("reason", "the benchmark was interrupted")
    if not reason and metrics.timing.cpu_seconds is None:
        reason = f"its {METRICS} has no timing"
    if reason:
        return JobResult(job, Metrics(), commit, reason)
    return JobResult(job, metrics, commit, "", record["seconds"], record["load"])


def revision(checkout: Path = ROOT) -> str:
    """The commit, with ``-dirty`` where sources were changed since; empty outside a checkout."""
    if shutil.which("git") is None or not (checkout / ".git").exists():
        return ""

    def git(*words: str) -> str:
        return subprocess.run(["git", "-C", str(checkout), *words], capture_output=True, text=True, check=True).stdout

    changed = git("status", "--porcelain", "--", *SOURCES)
    return git("rev-parse", "--short=12", "HEAD").strip() + ("-dirty" if changed else "")


def workers(count: int, scheduler: str | None) -> AbstractContextManager[Spread]:
    """A map over jobs: one after another, or through Dask, whose workers need not have these modules."""
    return cluster.workers(count, scheduler, (plan, sys.modules[__name__]))


def measured(jobs: Sequence[Job], spread: Spread) -> list[JobResult]:
    """Make the worlds that are missing, run what was not run before.

    Raises:
        SystemExit: a world could not be made.
    """
    drives = {job.drive.root: job.drive for job in jobs if job.drive.simulate}
    for _, ended in spread(simulate, list(drives.values())):
        if isinstance(ended, Exception):
            raise ended
    missing = [drive.name for drive in drives.values() if not drive.root.is_dir()]
    if missing:
        raise SystemExit(f"could not be simulated: {', '.join(missing)}")
    for done, (_, ended) in enumerate(spread(perform, jobs), 1):
        if isinstance(ended, Exception):
            raise ended
        print(f"{done} of {len(jobs)} runs", file=sys.stderr)
    return [job_result(job) for job in jobs]


def _read(path: Path) -> dict[str, Any]:
    """A JSON object; an empty one where there is no file."""
    tree: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    return tree


def ratio(part: float | None, whole: float | None, unit: float) -> float | None:
    """A part of a whole, in a unit."""
    return None if part is None or not whole else unit * part / whole


@cache
def loops(folder: Path) -> tuple[int | None, int | None]:
    """Number of true and of false loops of a run; None without truth in metres."""
    if not (folder / METRICS).is_file():
        return None, None
    metrics, reference = Metrics.read(folder / METRICS), RunFolder(folder).trajectory("reference")
    if reference is None or not metrics.is_metric or metrics.loops.accepted is None:
        return None, None
    accepted = LoopsFile.read(folder / LOOPS).accepted or []
    false = sum(
        is_false(np.array(loop.T_from_to), *reference.T_world_camera[[loop.from_, loop.to]]) for loop in accepted
    )
    return len(accepted) - false, false


def is_false(T_from_to: FloatArray, T_world_from: FloatArray, T_world_to: FloatArray) -> bool:
    """Whether a measured relative pose, metres, is too far off the true one."""
    off = invert(invert(T_world_from) @ T_world_to) @ T_from_to
    far = np.linalg.norm(off[:3, 3]) > FALSE_M
    return bool(far or rotation_angle(off[:3, :3]) > np.deg2rad(FALSE_DEG))
