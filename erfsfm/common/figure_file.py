"""Figures as files: whole or not at all, without a date, and never in place of an image that is none of ours."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from erfsfm.common.errors import ConfigError
from erfsfm.common.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARK = "erfsfm"
_METADATA: dict[str, dict[str, str | None]] = {
    ".png": {"Software": _MARK},
    ".pdf": {"Creator": _MARK, "CreationDate": None},
    ".svg": {"Creator": _MARK, "Date": None},
}
SUFFIXES = tuple(_METADATA)


def require_figure(path: Path) -> None:
    """Check that a figure may be written there, before it is drawn.

    Raises:
        ConfigError: another format, or a file that no figure of ours is.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"figures are written as {', '.join(SUFFIXES)}; got '{path.name}'")
    if path.is_file() and _MARK.encode() not in path.read_bytes():
        raise ConfigError(f"{path} exists and is no figure of erfsfm: choose another --output, or remove it")


def save_figure(figure: Figure, path: Path, dpi: int) -> None:
    """Write a figure in the format of its name; equal figures are equal files.

    Raises:
        ConfigError, OSError: it may not or cannot be written.
    """
    require_figure(path)
    suffix = path.suffix.lower()
    metadata = _METADATA[suffix]
    write_atomically(path, lambda part: figure.savefig(part, format=suffix[1:], dpi=dpi, metadata=metadata))
