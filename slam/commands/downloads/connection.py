"""Requests for parts of a file on a server, which must stay the same file, and what all downloads check."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from slam.runtime.errors import DownloadError
from slam.runtime.imports import import_extra

CHUNK = 1 << 20
_TIMEOUT_S = 30.0
_ATTEMPTS = 3

T = TypeVar("T")
Identity = tuple[str | None, str | None, str]  # ETag, Last-Modified, size


class BrokenError(DownloadError):
    """The connection broke: another attempt may do."""


class Connection:
    """A session with one file on a server.

    Attributes:
        url: of the file.
    """

    def __init__(self, url: str) -> None:
        """No request is sent.

        Raises:
            DownloadError: remotezip is not installed.
        """
        _, requests, _ = import_extra("download")
        self.url = url
        self._session: Any = requests.Session()
        self._identity: Identity | None = None

    def get(self, first: int, last: int | None = None) -> Any:
        """The response with bytes ``first`` to ``last`` of the file; a negative ``first`` counts from its end.

        Raises:
            DownloadError: it is another file than at the first request, or the server gives no ranges.
            OSError: it does not answer, or refuses.
        """
        wanted = f"bytes={first}-{'' if last is None else last}" if first >= 0 else f"bytes={first}"
        headers = {"Range": wanted, "Accept-Encoding": "identity"}
        response = self._session.get(self.url, headers=headers, stream=True, timeout=_TIMEOUT_S)
        response.raise_for_status()
        given = response.headers.get("Content-Range")
        if given is None:
            response.close()
            raise DownloadError(
                f"{self.url}: the server gives no parts of files (HTTP ranges): fetch the whole file there"
            )
        identity = response.headers.get("ETag"), response.headers.get("Last-Modified"), given.rpartition("/")[2]
        if self._identity is not None and identity != self._identity:
            response.close()
            raise DownloadError(f"{self.url} was changed on the server during the download: run the same command again")
        self._identity = identity
        return response


@contextmanager
def connection_errors(url: str, what: str) -> Iterator[None]:
    """Raise what a broken connection leads to as one line.

    Raises:
        BrokenError: with what to do.
        DownloadError: the address is none of a server.
    """
    remotezip, requests, urllib3 = import_extra("download")
    exceptions = requests.exceptions
    try:
        yield
    except (exceptions.MissingSchema, exceptions.InvalidSchema, exceptions.InvalidURL) as error:
        raise DownloadError(f"{url} is no address: give --mirror as https://HOST/FOLDER") from error
    except (OSError, EOFError, remotezip.RemoteZipError, urllib3.HTTPError) as error:
        raise BrokenError(f"{url}: {what} ({_cause(error)}); run the same command again to go on") from error


def retried(attempt: Callable[[], T]) -> T:
    """The result of an attempt; after a `BrokenError` there are two more."""
    for _ in range(_ATTEMPTS - 1):
        with suppress(BrokenError):
            return attempt()
    return attempt()


def require_space(folder: Path, size: int) -> None:
    """Refuse before anything is fetched where the disk is too small.

    Args:
        folder: where files are written; it is there.
        size: bytes that are still missing.

    Raises:
        DownloadError: with both sizes.
    """
    free = shutil.disk_usage(folder).free
    if size > free:
        raise DownloadError(f"{folder} has {free / 1e9:.1f} GB free, {size / 1e9:.1f} GB are needed: give another --to")


def _cause(error: BaseException) -> str:
    """What the system says, such as that the connection was refused, else the error itself."""
    first: BaseException | None = error
    while first is not None:
        if isinstance(first, OSError) and first.strerror:
            return first.strerror
        first = first.__context__
    return " ".join(f"{type(error).__name__}: {error}".split())
