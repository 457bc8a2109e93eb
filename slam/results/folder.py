"""A run folder: all files of a run, each whole or absent."""

from __future__ import annotations

import logging
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any

from erfsfm.common.files import FolderLock
from slam.formats.trajectory import Trajectory, read_trajectory, write_kitti, write_tum
from slam.results.metrics import Metrics
from slam.results.output import claim, stamped
from slam.runtime.errors import RunError
from slam.runtime.imports import import_open3d
from slam.runtime.run_files import ESTIMATE, MAP_CLOUD, MAP_MESH, METRICS, REPORT, trajectory_file
from slam.runtime.storage.files import write_atomically
from slam.runtime.storage.record import NOT_RECORDED

logger = logging.getLogger(__name__)


class RunFolder:
    """The files of one run, under the names of the contract (``docs/run-folder.md``)."""

    def __init__(self, path: str | Path) -> None:
        """A folder that exists, such as ``results/latest``.

        Raises:
            RunError: it is not there.
        """
        self.path = Path(path)
        if not self.path.is_dir():
            raise RunError(f"{path} is not there: give a folder that 'erfsfm-slam run' wrote")

    @classmethod
    def create(cls, output: Path | None, results: Path, sequence: str, lock: FolderLock | None = None) -> RunFolder:
        """A new folder: ``output`` itself, or ``results/<stamp>_<sequence>`` with ``results/latest`` linked to it.

        Where ``output`` holds an earlier run, that is removed. A ``lock`` holds the folder from now on.

        Raises:
            RunError: ``output`` exists and holds something else than a run, or the folder cannot be made.
            BusyError: another process holds ``output``.
        """
        try:
            if output is None:
                folder = cls(stamped(results, sequence))
                if lock is not None:
                    lock.take(folder.path)
                return folder
            if lock is not None:
                lock.take(output)
            claim(output)
            return cls(output)
        except OSError as error:
            where = output if output is not None else results
            raise RunError(f"no run folder can be made in {where}: {error.strerror or error}") from error

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """An existing run, also one that failed or was killed, with a warning.

        Raises:
            RunError: no run there.
        """
        path = Path(path)
        if not (path / METRICS).is_file() and not (path / ESTIMATE).is_file():
            what = "no such folder" if not path.exists() else f"it holds no {METRICS}"
            raise RunError(f"{path} is not a run folder: {what}; give a folder that 'erfsfm-slam run' wrote")
        folder = cls(path)
        metrics = folder.metrics()
        if metrics.failure:
            logger.warning("%s: %s: files that are there are whole", path, metrics.failure)
        return folder

    def write_text(self, name: str, text: str) -> None:
        """Write a text file atomically."""
        self.write(name, lambda path: path.write_text(text, encoding="utf-8"))

    def write(self, name: str, fill: Callable[[Path], object]) -> None:
        """Write a file atomically: ``fill`` writes it under a temporary name."""
        write_atomically(self.path / name, fill, RunError)

    def write_metrics(self, metrics: Metrics) -> None:
        """Write ``metrics.json``."""
        self.write_text(METRICS, metrics.to_json() + "\n")

    def write_trajectory(self, name: str, trajectory: Trajectory) -> None:
        """Write one of the trajectories (``network``, ``optimised``, ``reference`` ...) in both formats."""
        write_kitti(self.path / trajectory_file(name, "kitti"), trajectory)
        write_tum(self.path / trajectory_file(name, "tum"), trajectory)

    def metrics(self) -> Metrics:
        """The content of ``metrics.json``; without the file, the status of a killed run.

        Raises:
            RunError: the file is damaged.
        """
        try:
            return Metrics.read(self.path / METRICS)
        except FileNotFoundError:
            return Metrics(schema_=1, status="running", reason=f"the run was killed before it wrote {METRICS}")

    def trajectory(self, name: str) -> Trajectory | None:
        """One of the trajectories (``network``, ``optimised``, ``reference`` ...), or None where absent."""
        path = self.path / trajectory_file(name, "tum")
        return read_trajectory(path, "tum") if path.exists() else None

    def mesh(self) -> Any:
        """The map as an Open3D ``TriangleMesh``, y down; `RunError` where the run has none."""
        return import_open3d().io.read_triangle_mesh(str(self.require(MAP_MESH)))

    def cloud(self) -> Any:
        """The map as an Open3D ``PointCloud``, y down; `RunError` where the run has none."""
        return import_open3d().io.read_point_cloud(str(self.require(MAP_CLOUD)))

    def _repr_html_(self) -> str:
        """What a notebook shows: errors, and the unit of lengths."""
        from slam.results.tables import errors_table

        metrics = self.metrics()
        title = f"{metrics.sequence.name or self.path.name}: {metrics.sequence.frames or 0} frames"
        errors = metrics.evaluated_errors()
        notes = [note for note in (metrics.failure, *metrics.unit_notes()) if note]
        if (self.path / REPORT).is_file():
            notes.append(f"Report: {self.path / REPORT}")
        table = errors_table(errors).html() if errors else ""
        return f"<h4>{escape(title)}</h4>{table}" + "".join(f"<p>{escape(note)}</p>" for note in notes)

    def require(self, name: str) -> Path:
        """The path of a file of the run.

        Raises:
            RunError: it is not there.
        """
        path = self.path / name
        if not path.is_file():
            present = ", ".join(sorted(p.name for p in self.path.iterdir() if not p.name.startswith(".")))
            why = self._without_map() if name.endswith(".ply") else f"it holds {present}"
            raise RunError(f"{self.path} has no {name}: {why}")
        return path

    def _without_map(self) -> str:
        metrics = self.metrics()
        why = metrics.map.why("triangles")
        return (metrics.failure or "it ran without a map") if why == NOT_RECORDED else why
