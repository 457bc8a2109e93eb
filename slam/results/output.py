"""Where a command may write: a new or empty folder, one of an earlier run, and files of the kind that it writes.

Only files of a run are ever removed, and only from a folder whose ``metrics.json`` is that of a run.
"""

from __future__ import annotations

import itertools
import logging
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from erfsfm.common.files import unfinished_name
from slam.formats.trajectory import read_trajectory
from slam.results.metrics import Metrics
from slam.runtime.errors import RunError, TrajectoryError
from slam.runtime.run_files import ESTIMATE, MEANINGS, METRICS

logger = logging.getLogger(__name__)

_TRAJECTORIES = (".txt", ".tum", ".kitti")


def check_replaced(path: Path, beginnings: Mapping[str, bytes] | None = None) -> None:
    """Check what a file would replace.

    Args:
        path: the file to write.
        beginnings: ends of the names that it may have, and how such files begin; None of any trajectory.

    Raises:
        RunError: a folder, a file of a run, or one of another kind.
    """
    if path.is_dir():
        raise RunError(f"{path} is a folder: give the name of a file to write")
    if path.name in MEANINGS and any((path.parent / name).is_file() for name in (METRICS, ESTIMATE)):
        raise RunError(f"{path} is a file of a run: choose another --output")
    if path.is_file() and path.stat().st_size and not _is_of_kind(path, beginnings):
        raise RunError(f"{path} exists and is a file of another kind than is written: choose another --output")


def _is_of_kind(path: Path, beginnings: Mapping[str, bytes] | None) -> bool:
    suffix = path.suffix.lower()
    if suffix not in (_TRAJECTORIES if beginnings is None else beginnings):
        return False
    if beginnings is not None:
        with path.open("rb") as file:
            return file.read(64).startswith(beginnings[suffix])
    try:
        read_trajectory(path)
    except TrajectoryError:
        return False
    return True


def check_output(output: Path) -> None:
    """Check that a run may write to ``output``: it is new, empty, or holds an earlier run.

    Raises:
        RunError: it is a file, or holds files of something else.
    """
    if output.is_symlink() and not output.exists():
        raise RunError(f"{output} is a link to {output.readlink()}, which is not there: choose another --output")
    if not output.exists():
        return
    if not output.is_dir():
        raise RunError(f"{output} is a file: give a folder as --output")
    if not _is_run(output / METRICS) and any(not _is_rest(path) for path in output.iterdir()):
        raise RunError(f"{output} is not empty and holds no run of erfsfm-slam: choose another --output")


def claim(output: Path) -> None:
    """Make the folder of a new run, without files of earlier ones; other files stay.

    Raises:
        RunError: as `check_output`.
        OSError: the folder cannot be made.
    """
    check_output(output)
    output.mkdir(parents=True, exist_ok=True)
    for path in sorted(output.iterdir(), key=lambda path: path.name == METRICS):  # by which it is known as a run
        if path.name in MEANINGS or _is_rest(path):
            path.unlink()


def stamped(results: Path, sequence: str) -> Path:
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
    return content.provenance.weights_sha256 is not None and {"schema_", "status"} <= content.model_fields_set


def _is_rest(path: Path) -> bool:
    """Whether it is a partial file of a killed run."""
    return unfinished_name(path) in MEANINGS


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
