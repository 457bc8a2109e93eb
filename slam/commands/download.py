"""Sequences of KITTI odometry from its official server: of its archives, only the files that are wanted."""

from __future__ import annotations

import re
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from erfsfm.common.errors import one_line
from erfsfm.common.progress import Progress
from slam.runtime.errors import SlamError
from slam.runtime.files import write_atomically
from slam.runtime.imports import import_extra

LICENCE = """KITTI odometry: A. Geiger, P. Lenz, C. Stiller, R. Urtasun; Karlsruhe Institute of Technology and Toyota
Technological Institute at Chicago. Licence: Creative Commons Attribution-NonCommercial-ShareAlike 3.0
(https://creativecommons.org/licenses/by-nc-sa/3.0/): name the authors, not for commercial purposes, share what
you derive under the same licence. Terms: https://www.cvlibs.net/datasets/kitti/
Cite: A. Geiger, P. Lenz, R. Urtasun: Are we ready for Autonomous Driving? CVPR 2012."""
SERVER = "https://s3.eu-central-1.amazonaws.com/avg-kitti"
_WITH_POSES = 11  # sequences 00 to 10
_SEQUENCES = 22
_COLOUR, _GREY = ("data_odometry_color.zip", "image_2"), ("data_odometry_gray.zip", "image_0")
_CALIBRATION, _POSES, _SCANS = (
    "data_odometry_calib.zip",
    "data_odometry_poses.zip",
    "data_odometry_velodyne.zip",
)
_NAME = re.compile(r"\d\d")
_CHUNK = 1 << 20
_TIMEOUT_S = 30.0
_RETRIES = 3  # of a connection that is refused or lost before an answer


def download_kitti(
    sequence: str, folder: Path, server: str, is_grey: bool, with_scans: bool, progress: Progress
) -> int:
    """Fetch one sequence as an odometry root: images of the left camera, calibration, times and poses.

    Files that are there already are kept, so an interrupted download goes on.

    Args:
        sequence: ``00`` to ``21``; poses are public of the first eleven.
        folder: gets ``dataset/sequences/NN`` and ``dataset/poses/NN.txt``.
        server: address of the folder of the archives.
        is_grey, with_scans: the grey camera instead of the colour camera; LiDAR as well.
        progress: is told how many of the files, whose number is returned, are there.
    """
    if not _NAME.fullmatch(sequence) or int(sequence) >= _SEQUENCES:
        raise SlamError(f"KITTI odometry has no sequence {sequence}: give 00 to {_SEQUENCES - 1}")
    archive, camera = _GREY if is_grey else _COLOUR
    home = f"dataset/sequences/{sequence}"
    wanted: list[tuple[str, tuple[str, ...]]] = [
        (_CALIBRATION, (f"{home}/calib.txt", f"{home}/times.txt"))
    ]
    if int(sequence) < _WITH_POSES:
        wanted.append((_POSES, (f"dataset/poses/{sequence}.txt",)))
    wanted.append((archive, (f"{home}/{camera}/",)))
    if with_scans:
        wanted.append((_SCANS, (f"{home}/velodyne/",)))
    sources = [_RemoteZip(f"{server.rstrip('/')}/{name}") for name, _ in wanted]
    parts = [
        (source, member)
        for source, (_, prefixes) in zip(sources, wanted)
        for member in source.matching(*prefixes)
    ]
    folder.mkdir(parents=True, exist_ok=True)
    missing = sum(
        member.file_size for _, member in parts if not (folder / member.filename).is_file()
    )
    free = shutil.disk_usage(folder).free
    if missing > free:
        raise SlamError(
            f"{folder} has {free / 1e9:.1f} GB free, {missing / 1e9:.1f} GB are needed: give another --to"
        )
    for done, (source, member) in enumerate(parts, 1):
        source.fetch(member, folder)
        progress("files", done, len(parts))
    return len(parts)


class _RemoteZip:
    """A zip archive on a server whose table of contents was read."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._archive = self._open()

    def matching(self, *prefixes: str) -> list[zipfile.ZipInfo]:
        """Files whose names begin with one of the prefixes, in the order in which they are stored."""
        members = [
            m
            for m in self._archive.infolist()
            if m.filename.startswith(prefixes) and not m.is_dir()
        ]
        if not members:
            raise SlamError(
                f"{self.url} has no {' or '.join(prefixes)}: check the name of the sequence"
            )
        for member in members:
            path = PurePosixPath(member.filename)
            if path.is_absolute() or ".." in path.parts or "\\" in member.filename:
                raise SlamError(
                    f"{self.url} has a member {member.filename!r} outside of its folder: not unpacked"
                )
        return sorted(members, key=lambda member: member.header_offset)

    def fetch(self, member: zipfile.ZipInfo, folder: Path) -> None:
        """Write one member under a folder; one that is there with the same size and CRC stays."""
        path = folder / member.filename
        is_there = path.is_file() and path.stat().st_size == member.file_size
        if not is_there or zlib.crc32(path.read_bytes()) != member.CRC:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, lambda part: self._copy(member, part), sync=False)

    def _copy(self, member: zipfile.ZipInfo, path: Path) -> None:
        broken = self._errors(f"{member.filename} broke off")
        with broken, self._archive.open(member) as source, path.open("wb") as file:
            shutil.copyfileobj(source, file, _CHUNK)

    def _open(self) -> Any:
        remotezip, requests, _ = import_extra("download")
        options = {"timeout": _TIMEOUT_S, "headers": {"Accept-Encoding": "identity"}}
        session = requests.Session()
        for scheme in ("http://", "https://"):
            session.mount(scheme, requests.adapters.HTTPAdapter(max_retries=_RETRIES))
        with self._errors("cannot be read"):
            try:
                return remotezip.RemoteZip(self.url, session=session, **options)
            except remotezip.RangeNotSupported as error:
                raise SlamError(
                    f"{self.url}: the server gives no parts of files (HTTP ranges): fetch the whole file there"
                ) from error
            except (zipfile.BadZipFile, ValueError) as error:
                raise SlamError(
                    f"{self.url} is no zip archive ({error}): check the address"
                ) from error

    @contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        """Raise what a broken connection or a damaged file leads to as one line."""
        remotezip, _, urllib3 = import_extra("download")
        broken = (
            OSError,
            EOFError,
            remotezip.RemoteZipError,
            urllib3.HTTPError,
            zipfile.BadZipFile,
            zlib.error,
        )
        try:
            yield
        except broken as error:
            # what requests says of an address without server
            if isinstance(error.__context__, ValueError):
                raise SlamError(
                    f"{self.url} is no address: give --mirror as https://HOST/FOLDER"
                ) from error
            raise SlamError(
                f"{self.url}: {what} ({_cause(error)}); run the same command again to go on"
            ) from error


def _cause(error: BaseException) -> str:
    """What the system says, such as that the connection was refused, else the error itself."""
    first: BaseException | None = error
    while first is not None:
        if isinstance(first, OSError) and first.strerror:
            return first.strerror
        first = first.__context__
    return one_line(f"{type(error).__name__}: {error}")
