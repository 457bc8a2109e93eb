"""The output folder of a run: ``--output``, or a new one in ``results``.

Only files of a run are ever removed, and only from a folder whose ``metrics.json`` is that of a run.
"""

from __future__ import annotations

import logging
import os
import re
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from erfsfm.common.files import unfinished_name
from slam.results.metrics import Metrics
from slam.runtime.errors import RunError
from slam.runtime.run_files import MEANINGS, METRICS

logger = logging.getLogger(__name__)


def check_output(output: Path) -> None:
    """Check that a run may write to ``output``: it is new, empty, or holds an earlier run.

    Raises:
        RunError: it is a file, or holds files of something else, or a folder where a run has a file.
    """
    if output.is_symlink() and not output.exists():
        raise RunError(
            f"{output} is a link to {output.readlink()}, which is not there: make it, or choose another --output"
        )
    if not output.exists():
        return
    if not output.is_dir():
        raise RunError(f"{output} is a file: give a folder as --output")
    if not _is_run(output / METRICS) and any(not _is_rest(path) for path in output.iterdir()):
        raise RunError(f"{output} is not empty and holds no run of erfsfm-slam: choose another --output")
    for path in output.iterdir():
        if path.name in MEANINGS and path.is_dir():
            raise RunError(f"{path} is a folder, where a run writes a file: move it away, or choose another --output")


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
    path = results / f"{stamp}_{safe}"
    results.mkdir(parents=True, exist_ok=True)
    number = 1
    while not _made(path):
        number += 1
        path = results / f"{stamp}-{number}_{safe}"
    _link(results / "latest", path)
    return path


def _made(path: Path) -> bool:
    """Make a folder, unless it is there: another run may begin in the same second."""
    try:
        path.mkdir()
    except FileExistsError:
        return False
    return True


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
