"""A run folder: everything that a run leaves behind, each file whole or absent."""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from slam.errors import RunError
from slam.storage.files import write_atomically
from slam.trajectory import Trajectory, read_trajectory, write_kitti, write_tum

logger = logging.getLogger(__name__)

TRAJECTORIES = ("network", "odometry", "optimised", "lidar")
_STEMS = ("reference", *(f"trajectory_{name}" for name in TRAJECTORIES))
_OWN = frozenset(f"{stem}.{kind}.txt" for stem in _STEMS for kind in ("kitti", "tum")) | {
    "config.yaml",
    "metrics.json",
    "graph.g2o",
    "loops.json",
    "places.npz",
    "drive.zip",
    "keyframes.npz",
    "map_mesh.ply",
    "map_cloud.ply",
    "report.html",
    "run.log",
}


class RunFolder:
    """The files of one run, under the names of the contract (``docs/outputs.md``)."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(cls, output: Path | None, results: Path, sequence: str) -> RunFolder:
        """A new folder: ``output`` itself, or ``results/<stamp>_<sequence>`` with ``results/latest`` to it.

        Raises:
            RunError: ``output`` exists and holds something that is not a run, or no folder can be made there.
        """
        try:
            return cls(_cleared(output) if output is not None else _stamped(results, sequence))
        except OSError as error:
            where = output if output is not None else results
            raise RunError(f"no run folder can be made in {where}: {error.strerror or error}") from error

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """An existing run.

        Raises:
            RunError: no run there.
        """
        if not (path / "metrics.json").is_file():
            what = "no such folder" if not path.exists() else "it holds no metrics.json"
            raise RunError(f"{path} is not a run folder: {what}; give a folder that 'erfsfm-slam run' wrote")
        return cls(path)

    def write_text(self, name: str, text: str) -> None:
        """Write a text file at once."""
        self.write(name, lambda path: path.write_text(text, encoding="utf-8"))

    def write(self, name: str, fill: Callable[[Path], object]) -> None:
        """Let ``fill`` write a file beside its place, then put it there."""
        write_atomically(self.path / name, fill, RunError)

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Write ``metrics.json``; a number that is not finite is a mistake and is refused."""
        self.write_text("metrics.json", json.dumps(metrics, indent=2, allow_nan=False) + "\n")

    def write_trajectory(self, stem: str, trajectory: Trajectory) -> None:
        """Write ``<stem>.kitti.txt`` and ``<stem>.tum.txt``."""
        write_kitti(self.path / f"{stem}.kitti.txt", trajectory)
        write_tum(self.path / f"{stem}.tum.txt", trajectory)

    def metrics(self) -> dict[str, Any]:
        """What ``metrics.json`` says.

        Raises:
            RunError: the file is damaged.
        """
        try:
            content: dict[str, Any] = json.loads((self.path / "metrics.json").read_text())
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise RunError(f"{self.path / 'metrics.json'} is damaged: {error}; run the sequence again") from error
        return content

    def trajectory(self, name: str) -> Trajectory | None:
        """One of the trajectories (``network``, ``optimised``, ``reference`` ...), or None where absent."""
        stem = name if name == "reference" else f"trajectory_{name}"
        path = self.path / f"{stem}.tum.txt"
        return read_trajectory(path, "tum") if path.is_file() else None

    def require(self, name: str) -> Path:
        """A file of the run.

        Raises:
            RunError: it is not there.
        """
        path = self.path / name
        if not path.is_file():
            present = ", ".join(sorted(p.name for p in self.path.iterdir() if not p.name.startswith(".")))
            raise RunError(f"{self.path} has no {name}: it holds {present}")
        return path


def _cleared(output: Path) -> Path:
    """``output`` as an empty run folder: an earlier run in it goes, files of other kinds beside it stay."""
    if output.exists() and not output.is_dir():
        raise RunError(f"{output} is a file: give a folder as --output")
    output.mkdir(parents=True, exist_ok=True)
    present = {path.name for path in output.iterdir()}
    if present - _OWN and "metrics.json" not in present:
        raise RunError(f"{output} is not empty and holds no run: choose another --output")
    for name in present & _OWN:
        (output / name).unlink()
    return output


def _stamped(results: Path, sequence: str) -> Path:
    """A new ``<stamp>_<sequence>`` in ``results``, with ``latest`` pointing to it."""
    safe = re.sub(r"[^\w.-]+", "-", sequence)
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    path = results / f"{stamp}_{safe}"
    number = 1
    while path.exists():
        number += 1
        path = results / f"{stamp}-{number}_{safe}"
    path.mkdir(parents=True)
    _link(results / "latest", path)
    return path


def _link(link: Path, target: Path) -> None:
    """Point ``link`` to a sibling; a file system without links keeps the folders and loses the shortcut."""
    temporary = link.with_name(f".{link.name}.{os.getpid()}")
    try:
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(target.name, target_is_directory=True)
        temporary.replace(link)
    except OSError as error:
        logger.warning("could not link %s to %s: %s", link, target, error)
