"""Sequences of TUM RGB-D, each one archive."""

from __future__ import annotations

import gzip
import json
import re
import shutil
import tarfile
import zlib
from pathlib import Path

from erfsfm.common.progress import Progress
from slam.commands.downloads.connection import CHUNK, BrokenError, Connection, connection_errors, require_space, retried
from slam.runtime.errors import DownloadError

LICENCE = """TUM RGB-D: J. Sturm, N. Engelhard, F. Endres, W. Burgard, D. Cremers; Technical University of Munich.
Licence: Creative Commons Attribution 4.0 (https://creativecommons.org/licenses/by/4.0/): name the authors.
Terms: https://cvg.cit.tum.de/data/datasets/rgbd-dataset
Cite: J. Sturm et al.: A Benchmark for the Evaluation of RGB-D SLAM Systems. IROS 2012."""
SERVER = "https://cvg.cit.tum.de/rgbd/dataset"
_NAME = re.compile(r"(?:rgbd_dataset_)?(?P<name>freiburg(?P<camera>[123])_\w+)")


def download_tum(sequence: str, folder: Path, server: str, progress: Progress) -> Path:
    """Fetch one sequence and unpack it; a download that broke off goes on where it ended.

    Args:
        sequence: such as ``freiburg1_xyz``.
        folder: gets ``rgbd_dataset_freiburg1_xyz``.
        server: address of the folder of the archives.
        progress: called with (stage, done, total).

    Returns:
        The folder of the sequence.

    Raises:
        DownloadError: one line; the part that was fetched stays.
    """
    match = _NAME.fullmatch(sequence)
    if match is None:
        raise DownloadError(f"TUM RGB-D has no sequence {sequence}: give a name such as freiburg1_xyz")
    name = f"rgbd_dataset_{match['name']}"
    whole = folder / name
    if (whole / "rgb.txt").is_file():
        return whole
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / f"{name}.tgz.part"
    url = f"{server.rstrip('/')}/freiburg{match['camera']}/{name}.tgz"
    retried(lambda: _fetch(url, part, progress))
    _unpack(part, name, whole, url)
    return whole


def _fetch(url: str, part: Path, progress: Progress) -> None:
    """Append to what is there of the same file; of another it starts anew."""
    known = part.with_name(f"{part.name}.json")
    connection = Connection(url)
    with connection_errors(url, "cannot be reached"):
        connection.get(0, 0).close()
    identity = list(connection.identity)
    size = int(identity[2] or 0)
    if not known.is_file() or known.read_text(encoding="utf-8") != json.dumps(identity):
        part.unlink(missing_ok=True)
        known.write_text(json.dumps(identity), encoding="utf-8")
    there = part.stat().st_size if part.is_file() else 0
    require_space(part.parent, size - there)
    if there < size:
        with connection_errors(url, "broke off"), connection.get(there) as response, part.open("ab") as file:
            for chunk in response.iter_content(CHUNK):
                file.write(chunk)
                progress("bytes", file.tell(), size)
    if part.stat().st_size != size:
        raise BrokenError(f"{url}: broke off at {part.stat().st_size} of {size} bytes; run the same command again")


def _unpack(part: Path, name: str, whole: Path, url: str) -> None:
    """Unpack beside its place, without links or paths that lead out, and move it there when whole."""
    folder = part.with_name(f"{name}.unpacking")
    shutil.rmtree(folder, ignore_errors=True)
    known = part.with_name(f"{part.name}.json")
    try:
        with gzip.open(part) as file:
            with tarfile.open(fileobj=file, mode="r:") as archive:
                archive.extractall(folder, filter="data")
            while file.read(CHUNK):  # to the end, where gzip compares the CRC
                pass
        if not (folder / name / "rgb.txt").is_file():
            raise tarfile.TarError(f"it has no {name}/rgb.txt")
        (folder / name).rename(whole)
    except (tarfile.TarError, zlib.error, EOFError, OSError) as error:
        for path in (part, known):
            path.unlink(missing_ok=True)
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise DownloadError(f"{url} arrived damaged ({reason}): removed; run the same command again") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    for path in (part, known):
        path.unlink(missing_ok=True)
