"""Files that appear whole or not at all and are read up to a limit, figures, and folders that one process writes to."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import threading
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from erfsfm.common.errors import BusyError, ConfigError, OneLineError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_TEXT_BYTES = 256 * 2**20  # a trajectory of a million frames
MAX_IMAGE_BYTES = 2**30
_PARTIAL = re.compile(r"\.\d+\.\d+\.partial\.(?P<name>.+)")
_FIGURE_MARK = "erfsfm"
_FIGURE_METADATA: dict[str, dict[str, str | None]] = {
    ".png": {"Software": _FIGURE_MARK},
    ".pdf": {"Creator": _FIGURE_MARK, "CreationDate": None},
    ".svg": {"Creator": _FIGURE_MARK, "Date": None},
}
FIGURE_SUFFIXES = tuple(_FIGURE_METADATA)


def write_atomically(
    path: Path, content: str | bytes | Callable[[Path], object], sync: bool = True
) -> None:
    """Write ``content``, or let it write, a temporary file beside ``path``, then rename it; missing folders are made.

    The temporary name ends as ``path`` does, for writers that look at the suffix. With ``sync`` the disk holds the
    content before it gets its name; a disk that fills up late is found then.

    Raises:
        OSError: the file cannot be written, or is a folder, a device or a pipe; what was at ``path`` is unchanged.
    """
    if path.is_dir():
        raise OSError(f"{path}: cannot be written (it is a folder): give the name of a file")
    if path.exists() and not path.is_file():  # a superuser's rename would put a file in its place
        raise OSError(f"{path}: is a device or a pipe: give the name of a file")
    partial = path.with_name(f".{os.getpid()}.{threading.get_ident()}.partial.{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if callable(content):
            content(partial)
        else:
            partial.write_bytes(content.encode() if isinstance(content, str) else content)
        if sync:
            with partial.open("r+b") as file:
                os.fsync(file.fileno())
        partial.replace(path)
    except OSError as cause:
        raise OSError(f"{path}: cannot be written ({cause.strerror or cause})") from cause
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def refuse_foreign(files: Iterable[Path], mark: str, error: type[OneLineError]) -> None:
    """Refuse to replace files none of which has ``mark`` in it, by which a program knows its own.

    Raises:
        error: there are such files, and none has the mark.
    """

    def is_foreign(path: Path) -> bool:
        try:
            return mark.encode() not in read_bytes(path, MAX_TEXT_BYTES)
        except OSError:  # a folder, or a larger file
            return True

    there = [path for path in files if path.exists()]
    if there and all(map(is_foreign, there)):
        raise error(f"{there[0]} is none of ours and would be replaced: choose another --output")


def read_bytes(path: Path, most: int) -> bytes:
    """The content of a file, or pipe, that has no more than ``most`` bytes; else an ``OSError``.

    Raises:
        OSError: it cannot be read, or is larger.
    """
    if path.stat().st_size <= most:
        with path.open("rb") as file:  # a device has no size, and no end
            content = file.read(most + 1)
        if len(content) <= most:
            return content
    raise OSError(errno.EFBIG, f"larger than {most / 2**20:g} MiB", str(path))


def read_text(path: Path, encoding: str = "utf-8-sig", most: int = MAX_TEXT_BYTES) -> str:
    """A text file with the line ends of any system, and without the byte order mark of some editors."""
    return read_bytes(path, most).decode(encoding).replace("\r\n", "\n").replace("\r", "\n")


def unfinished_name(path: Path) -> str | None:
    """The name of the file that a killed process was writing to ``path``; None where ``path`` is no such leftover."""
    match = _PARTIAL.fullmatch(path.name)
    return match["name"] if match else None


def require_figure(path: Path) -> None:
    """Check that a figure may be written there, before it is drawn.

    Raises:
        ConfigError: a format that figures do not have, or a file that is no figure of ours.
    """
    if path.suffix.lower() not in FIGURE_SUFFIXES:
        raise ConfigError(f"figures are written as {', '.join(FIGURE_SUFFIXES)}; got '{path.name}'")
    refuse_foreign([path], _FIGURE_MARK, ConfigError)


def save_figure(figure: Figure, path: Path, dpi: int) -> None:
    """Write a figure in the format of its name; equal figures are equal files."""
    require_figure(path)
    suffix = path.suffix.lower()
    metadata = _FIGURE_METADATA[suffix]
    write_atomically(
        path, lambda part: figure.savefig(part, format=suffix[1:], dpi=dpi, metadata=metadata)
    )


class FolderLock(ExitStack):
    """Folders held until the end of a block, or of the process, however it ends; nothing is left in them."""

    def take(self, folder: Path, waits: bool = False) -> None:
        """Hold a folder, which is made; without effect where the file system has no locks, or no folder can be made.

        Where another process holds it, this one ``waits`` for its end, or is refused.

        Raises:
            BusyError: another process holds the folder, and this one does not wait.
        """
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        if not folder.is_dir():
            return
        descriptor = os.open(folder, os.O_RDONLY)
        self.callback(os.close, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX if waits else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BusyError(
                f"another process writes to {folder}: wait, or choose another --output"
            ) from error
        except OSError:  # no locks here
            return
