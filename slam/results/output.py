"""The output folder of a run: ``--output`` itself, or a folder in it while it still holds an earlier run.

Only files of a run are ever removed, and only from a folder whose ``metrics.json`` is that of a run.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from erfsfm.common.files import unfinished_name, write_atomically
from slam.mapping.submap import FOLDER as SUBMAPS
from slam.mapping.submap import remove_submaps
from slam.results.schema import MetricsFile
from slam.runtime.errors import RunError
from slam.runtime.storage.files import KEYFRAMES_PART
from slam.runtime.storage.json_file import read_json

logger = logging.getLogger(__name__)

METRICS = "metrics.json"
UNFINISHED = "unfinished"
TRAJECTORIES = ("network", "odometry", "optimised", "lidar")
ESTIMATE = "trajectory_optimised.tum.txt"
_STEMS = ("reference", *(f"trajectory_{name}" for name in TRAJECTORIES))
_OWN = frozenset(f"{stem}.{kind}.txt" for stem in _STEMS for kind in ("kitti", "tum")) | {
    "config.yaml",
    METRICS,
    "graph.g2o",
    "loops.json",
    "places.npz",
    "trajectory_optimised.geojson",
    "drive.zip",
    "keyframes.npz",
    "map_mesh.ply",
    "map_cloud.ply",
    "map_above.png",
    "map_driver.png",
    "report.html",
    "run.log",
}


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
        if is_own(path.name) and path.is_dir():
            raise RunError(f"{path} is a folder, where a run writes a file: move it away, or choose another --output")


def claim(output: Path) -> Path:
    """Make the folder of a new run, without files of earlier ones.

    It is ``output``, or ``output/unfinished`` where the trajectories of an earlier run are whole: they stay until
    `replace_run`.

    Raises:
        RunError: as `check_output`.
        OSError: the folder cannot be made.
    """
    check_output(output)
    place = output / UNFINISHED if (output / ESTIMATE).is_file() else output
    check_output(place)
    place.mkdir(parents=True, exist_ok=True)
    _clear(place)
    return place


def whole_place(folder: Path) -> Path:
    """Where a run will be once it is whole."""
    return folder.parent if folder.name == UNFINISHED and (folder.parent / ESTIMATE).is_file() else folder


def reclaim(output: Path) -> None:
    """Go on in the folder of a run that did not end: its files stay, what a killed process was writing goes."""
    for path in output.iterdir():
        if _is_rest(path):
            path.unlink()


def replace_run(output: Path, place: Path) -> None:
    """Put the run in ``place`` (``output/unfinished``) in place of the one in ``output``.

    Old files are removed before new ones are moved. Both folders have a ``metrics.json`` until the end, so that the
    next run recognises them as runs and replaces them, wherever this was interrupted.
    """
    write_atomically(output / METRICS, lambda path: shutil.copyfile(place / METRICS, path))
    remove_submaps(output / SUBMAPS)
    for path in _files(output):
        if path.name != METRICS:
            path.unlink()
    for path in sorted(_files(place), key=lambda path: path.name == METRICS):
        path.replace(output / path.name)
    with suppress(OSError):  # it holds other files
        place.rmdir()


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
        content = read_json(metrics, MetricsFile)
    except (OSError, RunError):
        return False
    if not {"schema", "status"} <= set(content):
        return False
    provenance = content.get("provenance")
    return isinstance(provenance, dict) and "weights_sha256" in provenance


def _is_rest(path: Path) -> bool:
    """Whether it is a partial file of a killed run."""
    name = unfinished_name(path)
    return name is not None and is_own(name)


def _files(folder: Path) -> list[Path]:
    """Files of a run, whole or partial."""
    return [path for path in folder.iterdir() if is_own(path.name) or _is_rest(path)]


def refuse_file_of_run(path: Path) -> None:
    """Refuse to write over, or among, what a run has written under the names of its own files.

    Raises:
        RunError: ``path`` has such a name in the folder of a run.
    """
    folder = path.parent
    if is_own(path.name) and ((folder / METRICS).is_file() or (folder / ESTIMATE).is_file()):
        raise RunError(f"{path} is a file of a run: choose another --output")


def is_own(name: str) -> bool:
    """Whether a run writes a file of this name."""
    return name in _OWN or KEYFRAMES_PART.fullmatch(name) is not None


def _clear(folder: Path) -> None:
    """Remove an earlier run with its partial files; other files stay."""
    check_output(folder / UNFINISHED)
    remove_submaps(folder / SUBMAPS)
    for path in _files(folder):
        path.unlink()
    if (folder / UNFINISHED).is_dir():
        _clear(folder / UNFINISHED)
        (folder / UNFINISHED).rmdir()


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
