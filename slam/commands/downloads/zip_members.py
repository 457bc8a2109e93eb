"""Members of a zip archive on a server, one by one, without the rest of it."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from slam.commands.downloads.connection import CHUNK, BrokenError, Connection, connection_errors, retried
from slam.runtime.errors import DownloadError
from slam.runtime.imports import import_extra
from slam.runtime.storage.files import write_atomically


class ZipMembers:
    """A zip archive on a server whose table of contents was read."""

    def __init__(self, url: str) -> None:
        """Read the table of contents.

        Raises:
            DownloadError: the server cannot be reached, gives no ranges, or has no zip archive there.
        """
        self.url = url
        self._connection = Connection(url)
        self._archive: Any = retried(self._open)

    def matching(self, *prefixes: str) -> list[zipfile.ZipInfo]:
        """Files whose names begin with one of the prefixes, in the order in which they are stored.

        Raises:
            DownloadError: there are none, or a name leads out of the folder.
        """
        members = [m for m in self._archive.infolist() if m.filename.startswith(prefixes) and not m.is_dir()]
        if not members:
            raise DownloadError(f"{self.url} has no {' or '.join(prefixes)}: check the name of the sequence")
        for member in members:
            path = PurePosixPath(member.filename)
            if path.is_absolute() or ".." in path.parts or "\\" in member.filename:
                raise DownloadError(f"{self.url} has a member {member.filename!r} outside of its folder: not unpacked")
        return sorted(members, key=lambda member: member.header_offset)

    def fetch(self, member: zipfile.ZipInfo, folder: Path) -> None:
        """Write one member under a folder; one that is there with the same size and CRC stays.

        Raises:
            DownloadError: the connection broke three times, the CRC is wrong, the archive was changed, or the file
                cannot be written.
        """
        path = folder / member.filename
        if _is_whole(path, member):
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        retried(lambda: self._fetch(member, path))

    def _fetch(self, member: zipfile.ZipInfo, path: Path) -> None:
        archive, self._archive = self._archive or self._open(), None  # after a failure it is opened again
        try:
            write_atomically(path, lambda partial: self._copy(archive, member, partial), DownloadError, sync=False)
        except (zipfile.BadZipFile, zlib.error) as error:  # the CRC, which zipfile compares
            raise BrokenError(f"{self.url}: {member.filename} arrives damaged ({error})") from error
        self._archive = archive

    def _copy(self, archive: Any, member: zipfile.ZipInfo, path: Path) -> None:
        with path.open("wb") as file:
            for chunk in self._chunks(archive, member):
                file.write(chunk)

    def _chunks(self, archive: Any, member: zipfile.ZipInfo) -> Iterator[bytes]:
        with connection_errors(self.url, f"{member.filename} broke off"), archive.open(member) as source:
            while chunk := source.read(CHUNK):
                yield chunk

    def _open(self) -> Any:
        remotezip, *_ = import_extra("download")
        connection, url = self._connection, self.url

        class Fetcher:
            """What remotezip asks for ranges."""

            def __init__(self, *_: Any, **__: Any) -> None:
                pass

            def fetch(self, data_range: tuple[int, int | None], stream: bool = False) -> Any:
                with connection_errors(url, "cannot be read"):  # zipfile takes an OSError for a damaged archive
                    response = connection.get(*data_range)
                first, _, last = (
                    response.headers["Content-Range"].removeprefix("bytes ").partition("/")[0].partition("-")
                )
                return remotezip.PartialBuffer(response.raw, int(first), int(last) - int(first) + 1, stream)

        with connection_errors(self.url, "cannot be read"):
            try:
                return remotezip.RemoteZip(self.url, fetcher=Fetcher)
            except (zipfile.BadZipFile, ValueError) as error:
                raise DownloadError(f"{self.url} is no zip archive ({error}): check the address") from error


def _is_whole(path: Path, member: zipfile.ZipInfo) -> bool:
    if not path.is_file() or path.stat().st_size != member.file_size:
        return False
    crc = 0
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            crc = zlib.crc32(chunk, crc)
    return crc == member.CRC
