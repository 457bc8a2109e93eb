"""The runs of a benchmark: recordings, configurations and their combinations."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

Condition = Literal["clean", "hazards"]


@dataclass(frozen=True)
class BenchmarkSequence:
    """A recording; one with ``simulate`` is made by ``erfsfm-slam simulate`` with those options.

    ``sequence`` is empty for a root that is one recording; ``truth`` is a file of its true poses.

    Drives of one ``kind`` are a row of the summary; ``clean`` names the same drive without hazards. ``truth`` is the
    file of its true poses, where it does not hold them itself.
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
class Configuration:
    """Overrides of a run."""

    name: str
    overrides: tuple[str, ...] = ()


QUIET = ("output.report=false",)
ACCURACY = (Configuration("default", QUIET),)
EVERYTHING = Configuration("everything on", QUIET)
_MAP_PARTS: dict[str, tuple[str, ...]] = {
    "depth not refined": ("depth.refine=none",),
    "range to 30 m": ("mapping.depth_max_m=30",),
    "holes left open": ("mapping.close_holes_m=0",),
    "no loops": ("loops.enabled=false",),
}
MAPS = (EVERYTHING, *(Configuration(name, (*QUIET, *off)) for name, off in _MAP_PARTS.items()))
FULL_SIZE = 1242, 375  # pixels of KITTI's colour cameras
ORIGINALS = ("kitti_odometry_original", "failures/kitti03_full")


@dataclass(frozen=True)
class Job:
    """One run of ``erfsfm-slam run``; ``folder`` holds the benchmark's runs."""

    folder: Path
    drive: BenchmarkSequence
    weights: str
    configuration: Configuration
    seed: int
    device: str = "cpu"

    @property
    def title(self) -> str:
        """Title in tables and logs."""
        return f"{self.drive.name}, {self.weights}, {self.configuration.name}, seed {self.seed}"

    @property
    def place(self) -> Path:
        """Folder of this run alone."""
        return self.folder / slug(self.title)

    @property
    def arguments(self) -> list[str]:
        """Arguments of ``erfsfm-slam``."""
        drive, configuration = self.drive, self.configuration
        words = ["run", "--dataset", str(drive.root), "--weights", self.weights]
        words += ["--sequence", drive.sequence] if drive.sequence else []
        words += ["--seed", str(self.seed), "--device", self.device, "--output", str(self.place / "run")]
        words += ["--frames", drive.frames] if drive.frames else []
        words += ["--truth", str(drive.truth)] if drive.truth else []
        return words + [word for override in configuration.overrides for word in ("--set", override)]


def plan(
    folder: Path,
    drives: Sequence[BenchmarkSequence],
    configurations: Sequence[Configuration],
    weights: Sequence[str],
    seeds: Sequence[int],
    changes: Sequence[str] = (),
    device: str = "cpu",
) -> list[Job]:
    """Every combination, configuration by configuration."""
    changed = [replace(c, overrides=(*c.overrides, *changes)) for c in configurations]
    return [Job(folder, d, w, c, s, device) for c in changed for s in seeds for w in weights for d in drives]


def worlds(
    folder: Path,
    routes: Sequence[str],
    seeds: Sequence[int],
    frames: int,
    conditions: Sequence[Condition] = ("clean",),
    truth: Sequence[Literal["depth"]] = (),
    size: tuple[int, int] | None = None,
) -> list[BenchmarkSequence]:
    """Simulated drives, in folders named by all parameters of the simulation; ``hazards`` are all of them at once.

    ``truth`` is what is written beside the images, ``size`` their width and height in place of the simulator's own.
    """
    from slam.simulation.hazards import Hazard
    from slam.simulation.options import VERSION

    every_hazard = ",".join(get_args(Hazard))
    flags, beside = [f"--{kind}" for kind in truth], "".join(f"-{kind}" for kind in truth)
    if size is not None:
        flags += ["--width", str(size[0]), "--height", str(size[1])]
        beside += f"-{size[0]}x{size[1]}"

    def world(route: str, seed: int, condition: Condition) -> BenchmarkSequence:
        name, words = f"{route} {seed}", ("--route", route, "--seed", str(seed), "--frames", str(frames), *flags)
        root = folder / f"{route}-{seed}-{frames}{beside}{'' if condition == 'clean' else '-hazards'}-v{VERSION}"
        if condition == "clean":
            return BenchmarkSequence(name, root, simulate=words, kind=route)
        words = (*words, "--hazards", every_hazard)
        return BenchmarkSequence(f"{name}, hazards", root, simulate=words, kind=f"{route}, hazards", clean=name)

    return [world(route, seed, condition) for condition in conditions for route in routes for seed in seeds]


def original_recordings(data: Path) -> list[BenchmarkSequence]:
    """Stretches of KITTI odometry at the size of its cameras, in a folder of recordings as the tests use it."""
    return [drive for root in ORIGINALS for drive in recordings(data / root, (), None)]


def recordings(kitti: Path, names: Sequence[str], frames: str | None) -> list[BenchmarkSequence]:
    """The sequences of a KITTI odometry root, all of them or those named."""
    from slam.sequences.catalogue import sequence_names

    chosen = names or sequence_names(kitti)
    return [BenchmarkSequence(f"KITTI {name}", kitti, name, frames, kind="KITTI") for name in chosen]


def raw_drives(folders: Sequence[Path]) -> list[BenchmarkSequence]:
    """KITTI raw drives, each a folder of its own."""
    return [BenchmarkSequence(folder.name, folder.resolve(), sequence="", kind="KITTI raw") for folder in folders]


def slug(text: str) -> str:
    """A name for files and columns."""
    return re.sub(r"[^\w.]+", "-", text).strip("-")
