"""The errors a user can cause; the command line prints them as one line and exits with 1."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from erfsfm.common.errors import DataError, OneLineError


class SlamError(OneLineError):
    """Base of every known error of the SLAM package."""


class ConfigError(SlamError):
    """A configuration file or option is wrong."""


class SequenceError(SlamError):
    """A sequence is missing, incomplete or malformed."""


class MissingFrameError(SequenceError):
    """A frame whose number is missing from the files of a sequence: a gap in time, which is interpolated."""


class CalibrationError(SlamError):
    """Images of a board do not give a camera."""


class DownloadError(SlamError):
    """A data set cannot be fetched from its server."""


class TrajectoryError(SlamError):
    """A trajectory file cannot be read, or two trajectories do not match."""


class RunError(SlamError):
    """A run folder is missing or incomplete."""


class EmptyMapError(SlamError):
    """A map without any surface."""


@contextmanager
def sequence_errors() -> Iterator[None]:
    """Raise what the readers of `erfsfm.common.readers` refuse as a `SequenceError`; also a decorator."""
    try:
        yield
    except DataError as error:
        raise SequenceError(str(error)) from error
