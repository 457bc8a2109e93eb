"""The runs of a benchmark: recordings, configurations, their combinations, what came out."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from erfsfm.common.processes import slam_process
from erfsfm.common.progress import progress_bar
from slam.commands.batch import Drive, run_drives
from slam.geometry.se3 import FloatArray, invert, rotation_angle
from slam.results.folder import RunFolder
from slam.results.metrics import LoopsFile, Metrics
from slam.runtime.files import GRAPH, LOOPS, MAP_CLOUD, MAP_MESH, METRICS, PLACES
from slam.sequences.catalogue import sequence_kinds
from slam.simulation.options import VERSION, Hazard

Condition = Literal["clean", "hazards"]
ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("erfsfm", "slam", "configs")  # folders that results depend on
BULKY = (MAP_MESH, MAP_CLOUD, PLACES, GRAPH)  # removed after a run: no table reads them
FALSE_M, FALSE_DEG = 2.0, 5.0  # a loop with a larger error is false

QUIET = ("output.report=false",)
EVERYTHING = "everything on"
# overrides of a run by the name of its configuration
ACCURACY: dict[str, tuple[str, ...]] = {"default": QUIET}
MAPS: dict[str, tuple[str, ...]] = {
    EVERYTHING: QUIET,
    "depth not refined": (*QUIET, "depth.refine=none"),
    "range to 30 m": (*QUIET, "mapping.depth_max_m=30"),
    "holes left open": (*QUIET, "mapping.close_holes_m=0"),
    "no loops": (*QUIET, "loops.enabled=false"),
}
# stretches of KITTI odometry at the size of its cameras, in a folder of recordings as the tests use it
ORIGINALS = ("kitti_odometry_original", "failures/kitti03_full")


@dataclass(frozen=True)
class BenchmarkSequence:
    """A recording; one with ``simulate`` is made by ``erfsfm-slam simulate`` with those options.

    ``sequence`` is empty for a root that is one recording; ``truth`` is a file of its true poses, where it does not
    hold them itself. Drives of one ``kind`` are a row of the summary; ``clean`` names the same drive without hazards.
    """

    name: str
    root: Path
    sequence: str = "sim"
    frames: str | None = None
    simulate: tuple[str, ...] = ()
    kind: str = ""
    clean: str = ""
    truth: Path | None = None


@dataclass(frozen=True)
class Job:
    """One run of ``erfsfm-slam run``; ``folder`` holds the benchmark's runs."""

    folder: Path
    drive: BenchmarkSequence
    weights: str
    configuration: str
    overrides: tuple[str, ...]
    seed: int
    device: str

    @property
    def title(self) -> str:
        """Title in tables and logs."""
        return f"{self.drive.name}, {self.weights}, {self.configuration}, seed {self.seed}"

    @property
    def place(self) -> Path:
        """Its run folder."""
        return self.folder / slug(self.title)

    @property
    def arguments(self) -> tuple[str, ...]:
        """Options of ``erfsfm-slam run``."""
        drive = self.drive
        words = ["--dataset", str(drive.root), "--weights", self.weights]
        words += ["--sequence", drive.sequence] if drive.sequence else []
        words += ["--seed", str(self.seed), "--device", self.device]
        words += ["--frames", drive.frames] if drive.frames else []
        words += ["--truth", str(drive.truth)] if drive.truth else []
        return (*words, *(word for override in self.overrides for word in ("--set", override)))


@dataclass(frozen=True)
class JobResult:
    """The metrics of a job, or the reason of its failure."""

    job: Job
    metrics: Metrics
    reason: str = ""


def plan(
    folder: Path,
    drives: Sequence[BenchmarkSequence],
    configurations: Mapping[str, Sequence[str]],
    weights: Sequence[str],
    seeds: Sequence[int],
    changes: Sequence[str],
    device: str,
) -> list[Job]:
    """Every combination, configuration by configuration.

    Args:
        folder: of all run folders.
        drives: recordings and simulated worlds.
        configurations: overrides by name.
        weights: names or folders.
        seeds: of the runs.
        changes: overrides of every configuration.
        device: where networks compute.
    """
    jobs = []
    for name, seed, each, drive in product(configurations, seeds, weights, drives):
        overrides = (*configurations[name], *changes)
        jobs.append(Job(folder, drive, each, name, overrides, seed, device))
    return jobs


def worlds(
    folder: Path,
    routes: Sequence[str],
    seeds: Sequence[int],
    frames: int,
    conditions: Sequence[Condition] = ("clean",),
    options: Sequence[str] = (),
) -> list[BenchmarkSequence]:
    """Simulated streets, with more ``options`` of ``simulate``; ``hazards`` are all of them at once."""
    found = []
    for condition, route, seed in product(conditions, routes, seeds):
        hazards = "" if condition == "clean" else ",".join(get_args(Hazard))
        words = ("--route", route, "--seed", str(seed), "--frames", str(frames), *options)
        found.append(simulated(folder, f"{route} {seed}", route, words, condition, hazards))
    return found


def simulated(
    folder: Path, name: str, kind: str, words: Sequence[str], condition: str, hazards: str
) -> BenchmarkSequence:
    """A world by the options of ``simulate``, in a folder that is named by all of them; without hazards it is clean."""
    words = (*words, *(("--hazards", hazards) if hazards else ()))
    root = folder / slug(" ".join([*words, f"v{VERSION}"]))
    if not hazards:
        return BenchmarkSequence(name, root, simulate=words, kind=kind)
    return BenchmarkSequence(
        f"{name}, {condition}", root, simulate=words, kind=f"{kind}, {condition}", clean=name
    )


def recordings(kitti: Path, names: Sequence[str], frames: str | None) -> list[BenchmarkSequence]:
    """The sequences of a KITTI odometry root, all of them or those named."""
    chosen = names or list(sequence_kinds(kitti))
    return [
        BenchmarkSequence(f"KITTI {name}", kitti, name, frames, kind="KITTI") for name in chosen
    ]


def raw_drives(folders: Sequence[Path]) -> list[BenchmarkSequence]:
    """KITTI raw drives, each a folder of its own."""
    return [
        BenchmarkSequence(folder.name, folder.resolve(), sequence="", kind="KITTI raw")
        for folder in folders
    ]


def measured(jobs: Sequence[Job], count: int, scheduler: str | None) -> list[JobResult]:
    """Make the worlds that are missing and run what was not run before, ``count`` at a time or by a Dask scheduler.

    Raises:
        SystemExit: a world could not be made.
    """
    simulated_drives = {job.drive.root: job.drive for job in jobs if job.drive.simulate}
    with ThreadPoolExecutor(count) as pool:
        list(pool.map(make, simulated_drives.values()))
    missing = [drive.name for drive in simulated_drives.values() if not drive.root.is_dir()]
    if missing:
        raise SystemExit(f"could not be simulated: {', '.join(missing)}")
    drives = [Drive(job.place.name, ROOT, job.arguments) for job in jobs]
    with progress_bar() as progress:
        outcomes = run_drives(drives, jobs[0].folder, count, scheduler, progress)
    for job in jobs:
        for name in BULKY:
            (job.place / name).unlink(missing_ok=True)
    metrics = [Metrics() if each.reason else RunFolder(each.folder).metrics() for each in outcomes]
    return [JobResult(job, found, each.reason) for job, found, each in zip(jobs, metrics, outcomes)]


def make(drive: BenchmarkSequence) -> None:
    """Simulate a world where it is missing."""
    if not drive.root.exists():
        slam_process(["simulate", str(drive.root), *drive.simulate])


def revision(checkout: Path = ROOT) -> str:
    """The commit, with ``-dirty`` where sources were changed since; ``unknown`` outside a checkout."""
    if shutil.which("git") is None or not (checkout / ".git").exists():
        return "unknown"

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(checkout), *words], capture_output=True, text=True, check=True
        ).stdout

    changed = git("status", "--porcelain", "--", *SOURCES)
    return git("rev-parse", "--short=12", "HEAD").strip() + ("-dirty" if changed else "")


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
        is_false(np.array(loop.T_from_to), *reference.T_world_camera[[loop.from_, loop.to]])
        for loop in accepted
    )
    return len(accepted) - false, false


def is_false(T_from_to: FloatArray, T_world_from: FloatArray, T_world_to: FloatArray) -> bool:
    """Whether a measured relative pose, metres, is too far off the true one."""
    off = invert(invert(T_world_from) @ T_world_to) @ T_from_to
    far = np.linalg.norm(off[:3, 3]) > FALSE_M
    return bool(far or rotation_angle(off[:3, :3]) > np.deg2rad(FALSE_DEG))


def slug(text: str) -> str:
    """A name for files and columns."""
    return re.sub(r"[^\w.]+", "-", text).strip("-")
