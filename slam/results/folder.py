"""A run folder: all files of a run, each whole or absent; its log; and what a command may write over.

Only files of a run are ever removed, and only from a folder whose ``metrics.json`` is that of a run. ``run.log`` is the
log of the package from the first check of a run to its end.
"""

from __future__ import annotations

import itertools
import logging
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from html import escape
from logging.handlers import MemoryHandler
from pathlib import Path
from typing import Any

from erfsfm.common.files import FolderLock, unfinished_name
from slam.formats.trajectory import Trajectory, read_trajectory, write_kitti, write_tum
from slam.results.metrics import Metrics
from slam.results.tables import errors_table
from slam.runtime.errors import RunError, TrajectoryError
from slam.runtime.files import (
    ESTIMATE,
    MAP_CLOUD,
    MAP_MESH,
    MEANINGS,
    METRICS,
    REFERENCE,
    REPORT,
    TRAJECTORIES,
    trajectory_file,
    write_atomically,
)
from slam.runtime.imports import import_open3d
from slam.runtime.record import NOT_RECORDED

logger = logging.getLogger(__name__)

_TRAJECTORIES = (".txt", ".tum", ".kitti")


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
    def create(
        cls, output: Path | None, results: Path, sequence: str, lock: FolderLock | None = None
    ) -> RunFolder:
        """A new folder: ``output`` itself, or ``results/<stamp>_<sequence>`` with ``results/latest`` linked to it.

        Where ``output`` holds an earlier run, that is removed. A ``lock`` holds the folder from now on.

        Args:
            output: the folder, as the user gave it; None for a new one with time and sequence in
                its name.
            results: where such a new one is made.
            sequence: the name of what is run.
            lock: holds the folder as long as the process runs; None for no lock.

        Raises:
            RunError: ``output`` exists and holds something else than a run, or the folder cannot be made.
            BusyError: another process holds ``output``.
        """
        try:
            if output is None:
                output = _stamped(results, sequence)
            check_output(output)
            if lock is not None:
                lock.take(output)
            output.mkdir(parents=True, exist_ok=True)
            # last of all the file by which it is known as a run
            for path in sorted(output.iterdir(), key=lambda path: path.name == METRICS):
                if path.name in MEANINGS or unfinished_name(path) in MEANINGS:
                    path.unlink()
            return cls(output)
        except OSError as error:
            where = output if output is not None else results
            raise RunError(
                f"no run folder can be made in {where}: {error.strerror or error}"
            ) from error

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """An existing run, also one that failed or was killed, with a warning.

        Raises:
            RunError: no run there.
        """
        path = Path(path)
        if not (path / METRICS).is_file() and not (path / ESTIMATE).is_file():
            what = "no such folder" if not path.exists() else f"it holds no {METRICS}"
            raise RunError(
                f"{path} is not a run folder: {what}; give a folder that 'erfsfm-slam run' wrote"
            )
        folder = cls(path)
        metrics = folder.metrics()
        if metrics.failure:
            logger.warning("%s: %s: files that are there are whole", path, metrics.failure)
        return folder

    def write(self, name: str, content: str | Callable[[Path], object]) -> None:
        """Write a file atomically: its text, or by a function that writes it under a temporary name.

        Args:
            name: of the file in the folder.
            content: its text, or what writes it to a path.

        Raises:
            RunError: the disk is full, or the folder is not writable.
        """
        write_atomically(self.path / name, content, RunError)

    def write_metrics(self, metrics: Metrics) -> None:
        """Write ``metrics.json``."""
        self.write(METRICS, metrics.to_json() + "\n")

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
            return Metrics(
                schema_=1, status="running", reason=f"the run was killed before it wrote {METRICS}"
            )

    def trajectory(self, name: str) -> Trajectory | None:
        """One of the trajectories (``network``, ``optimised``, ``reference`` ...), or None where absent.

        Raises:
            TrajectoryError: the file is there and cannot be read.
            RunError: no run has a trajectory of this name.
        """
        path = self.path / trajectory_file(name, "tum")
        if path.name not in MEANINGS:
            raise RunError(
                f"no run has a trajectory {name}: give {', '.join([REFERENCE, *TRAJECTORIES])}"
            )
        return read_trajectory(path, "tum") if path.exists() else None

    def mesh(self) -> Any:
        """The map as an Open3D ``TriangleMesh``, y down.

        Raises:
            RunError: the run has no map.
            SlamError: Open3D cannot be loaded.
        """
        return import_open3d().io.read_triangle_mesh(str(self.require(MAP_MESH)))

    def cloud(self) -> Any:
        """The map as an Open3D ``PointCloud``, y down.

        Raises:
            RunError: the run has no map.
            SlamError: Open3D cannot be loaded.
        """
        return import_open3d().io.read_point_cloud(str(self.require(MAP_CLOUD)))

    def _repr_html_(self) -> str:
        """What a notebook shows: errors, and the unit of lengths."""
        metrics = self.metrics()
        title = f"{metrics.sequence.name or self.path.name}: {metrics.sequence.frames or 0} frames"
        errors = metrics.evaluated_errors()
        notes = [note for note in (metrics.failure, *metrics.unit_notes()) if note]
        if (self.path / REPORT).is_file():
            notes.append(f"Report: {self.path / REPORT}")
        table = errors_table(errors).html() if errors else ""
        return f"<h4>{escape(title)}</h4>{table}" + "".join(
            f"<p>{escape(note)}</p>" for note in notes
        )

    def require(self, name: str) -> Path:
        """The path of a file of the run.

        Raises:
            RunError: the run has no such file; the message says why where the run knows.
        """
        path = self.path / name
        if not path.is_file():
            present = ", ".join(
                sorted(p.name for p in self.path.iterdir() if not p.name.startswith("."))
            )
            why = f"it holds {present}"
            if name.endswith(".ply"):
                metrics = self.metrics()
                why = metrics.map.why("triangles")
                why = (metrics.failure or "it ran without a map") if why == NOT_RECORDED else why
            raise RunError(f"{self.path} has no {name}: {why}")
        return path


def check_replaced(path: Path, begin: bytes | None = None) -> None:
    """Check what a file would replace: a file with this ``begin``, by default any trajectory.

    Args:
        path: of the file that is to be written.
        begin: the first bytes of a file that may be replaced; None for any trajectory.

    Raises:
        RunError: it is a folder, a file of a run, or a file of another kind.
    """
    if path.is_dir():
        raise RunError(f"{path} is a folder: give the name of a file to write")
    if path.name in MEANINGS and any(
        (path.parent / name).is_file() for name in (METRICS, ESTIMATE)
    ):
        raise RunError(f"{path} is a file of a run: choose another --output")
    if path.is_file() and path.stat().st_size and not _is_of_kind(path, begin):
        raise RunError(
            f"{path} exists and is a file of another kind than is written: choose another --output"
        )


def _is_of_kind(path: Path, begin: bytes | None) -> bool:
    if begin is not None:
        with path.open("rb") as file:
            return file.read(len(begin)) == begin
    try:
        return path.suffix.lower() in _TRAJECTORIES and len(read_trajectory(path)) > 0
    except TrajectoryError:
        return False


def check_output(output: Path) -> None:
    """Check that a run may write to ``output``: it is new, empty, or holds an earlier run.

    Raises:
        RunError: it is a broken link, a file, or a folder with something else than a run.
    """
    if output.is_symlink() and not output.exists():
        raise RunError(
            f"{output} is a link to {output.readlink()}, which is not there: choose another --output"
        )
    if not output.exists():
        return
    if not output.is_dir():
        raise RunError(f"{output} is a file: give a folder as --output")
    if not _is_run(output / METRICS) and any(
        unfinished_name(path) not in MEANINGS for path in output.iterdir()
    ):
        raise RunError(
            f"{output} is not empty and holds no run of erfsfm-slam: choose another --output"
        )


def _stamped(results: Path, sequence: str) -> Path:
    """A new ``<stamp>_<sequence>`` in ``results``, with ``latest`` pointing to it."""
    safe = re.sub(r"[^\w.-]+", "-", sequence)
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    results.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):  # another run may begin in the same second
        path = results / (f"{stamp}_{safe}" if number == 1 else f"{stamp}-{number}_{safe}")
        with suppress(FileExistsError):
            path.mkdir()
            break
    _link(results / "latest", path)
    return path


def _is_run(metrics: Path) -> bool:
    """Whether a ``metrics.json`` is that of a run, however it ended."""
    try:
        content = Metrics.read(metrics)
    except (OSError, RunError):
        return False
    return (
        content.provenance.weights_sha256 is not None
        and {"schema_", "status"} <= content.model_fields_set
    )


def _link(link: Path, target: Path) -> None:
    """Point ``link`` to a sibling; on a file system without links, only warn."""
    temporary = link.with_name(f".{link.name}.{os.getpid()}")
    try:
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(target.name, target_is_directory=True)
        temporary.replace(link)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        logger.warning("could not link %s to %s: %s", link, target, error)


class _LogFile(logging.FileHandler):
    def handleError(self, record: logging.LogRecord) -> None:
        """Lines that a full disk refuses are lost without a message."""


class RunLog(MemoryHandler):
    """Holds records until there is a file, then writes each at once.

    Of those that give one reason again and again the first is written, and at the end their number.
    """

    def __init__(self) -> None:
        super().__init__(capacity=1)
        self._times: Counter[tuple[str, str]] = Counter()

    def begin(self, path: Path) -> None:
        """Write the records so far and all further ones to a file."""
        file = _LogFile(path, encoding="utf-8", errors="backslashreplace")
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        self.setTarget(file)
        self.flush()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to write a record: it gives its reason for the first time, or none."""
        reason = record.args[-1] if isinstance(record.args, tuple) and record.args else None
        if record.levelno != logging.INFO or not isinstance(reason, str):
            return True
        self._times[record.msg, reason] += 1
        return self._times[record.msg, reason] == 1

    def failed(self, reason: str) -> None:
        """Write the reason of a failure to the file alone: the caller gets the exception."""
        self._say(logging.ERROR, f"the run failed: {reason}")

    def close(self) -> None:
        """Write how often reasons were given again and again, and close the file."""
        for (_, reason), times in self._times.items():
            if times > 1:
                self._say(logging.INFO, f"{times} times: {reason}")
        file = self.target
        super().close()
        if file is not None:
            with suppress(OSError):  # flushes again what a full disk refused
                file.close()

    def _say(self, level: int, message: str) -> None:
        self.handle(logging.LogRecord("slam.commands.run", level, __file__, 0, message, None, None))


@contextmanager
def run_log() -> Iterator[RunLog]:
    """Add a `RunLog` to the logger of the package."""
    log, root = RunLog(), logging.getLogger("slam")
    level = root.level
    root.addHandler(log)
    root.setLevel(logging.INFO)
    try:
        yield log
    finally:
        root.removeHandler(log)
        root.setLevel(level)
        log.close()
