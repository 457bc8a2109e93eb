"""The errors a user can cause; the command line prints them as one line and exits with 1."""

import os
import re
import traceback
from pathlib import Path

_LONGEST = 700
_LAST = 200
_OF_WORKER = "Original Traceback (most recent call last)"
# the user and password of an address, and what its query calls a secret
_USER = re.compile(r"(?<=://)[^\s/'\"]+@")
_SECRET = re.compile(r"(?<=[?&])(pass\w*|pwd|token|key|auth|secret)=[^\s&'\"]+", re.IGNORECASE)
SHOW_TRACEBACK = "ERFSFM_TRACEBACK"

OUT_OF_MEMORY = (
    "memory ran out; what was written stays: "
    "use fewer frames or smaller images, or a machine with more memory"
)
_MEMORY = (
    "not enough memory",
    "cannot allocate memory",
    "bad_alloc",
    "bad alloc",
    "can't start new thread",
)


def without_secrets(text: str) -> str:
    """A text that may name addresses of streams, without their users and passwords."""
    return _SECRET.sub(r"\1=...", _USER.sub("...@", text))


def one_line(text: str) -> str:
    """A message without line breaks and secrets; the middle of a very long one is left out.

    Of an error of a data loader's process, to which PyTorch adds its traceback, only the message stays.
    """
    if _OF_WORKER in text:
        text = text.strip().splitlines()[-1].partition(": ")[2]
    line = without_secrets(" ".join(text.splitlines()))
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - _LAST]} ... {line[-_LAST:]}"


class OneLineError(Exception):
    """An error whose text is one line of bounded length, whatever a damaged file puts into it."""

    def __str__(self) -> str:
        return one_line(super().__str__())


def explained(error: Exception) -> str:
    """Any error in one line; one that was not foreseen with its place."""
    said = str(error).lower()
    if isinstance(error, MemoryError) or any(words in said for words in _MEMORY):
        return OUT_OF_MEMORY
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return one_line(f"{error.filename}: {error.strerror}: check the path")
    if isinstance(error, OneLineError | OSError):
        return one_line(str(error))
    place = traceback.extract_tb(error.__traceback__)[-1]
    what = one_line(f"{type(error).__name__}: {error}")
    return f"unexpected {what} ({Path(place.filename).name}:{place.lineno}); set {SHOW_TRACEBACK}=1 and report this"


def shows_traceback() -> bool:
    """Whether the user wants an error as Python shows it."""
    return os.environ.get(SHOW_TRACEBACK, "0") not in ("", "0")


class ErfsfmError(OneLineError):
    """Base of every known error of the network package."""


class ConfigError(ErfsfmError):
    """A configuration, preset name or option is wrong."""


class BusyError(ErfsfmError):
    """Another process writes to a folder."""


class CheckpointError(ErfsfmError):
    """Weights are missing, damaged, or of another architecture."""


class DataError(ErfsfmError):
    """A data set is missing, incomplete or malformed."""


class TrainingError(ErfsfmError):
    """Training cannot start or continue."""


class ExportError(ErfsfmError):
    """A network cannot be written in another format."""
