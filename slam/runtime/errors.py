"""The errors a user can cause, which the command line prints as one line and exits with 1, and results that failed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from erfsfm.common.errors import DataError, OneLineError, explained, shows_traceback

logger = logging.getLogger(__name__)
T = TypeVar("T")


class SlamError(OneLineError):
    """Base of every known error of the SLAM package."""


class ConfigError(SlamError):
    """A configuration file or option is wrong."""


class SequenceError(SlamError):
    """A sequence is missing, incomplete or malformed."""


class MissingCameraError(SequenceError):
    """Nobody says which camera took the images of a sequence."""


class MissingFrameError(SequenceError):
    """A frame whose number is missing from the files of a sequence: a gap in time, which is interpolated."""


class TrajectoryError(SlamError):
    """A trajectory file cannot be read, or two trajectories do not match."""


class RunError(SlamError):
    """A run folder is missing or incomplete."""


class EmptyMapError(SlamError):
    """A map without any surface."""


@contextmanager
def sequence_errors() -> Iterator[None]:
    """Raise what the readers of `erfsfm.common.readers` refuse as a `SequenceError`; also a decorator.

    Raises:
        SequenceError: with the words of a `DataError` raised inside.
    """
    try:
        yield
    except DataError as error:
        raise SequenceError(str(error)) from error


@dataclass(frozen=True)
class Failed:
    """Why a measurement or a stage has no result: a text for the log and the report."""

    reason: str


def attempt(stage: str, compute: Callable[[], T]) -> T | Failed:
    """The result of a stage, or why there is none: an error costs the stage, with a warning that names its place.

    A disk without room is for the user to mend, and ``ERFSFM_TRACEBACK=1`` asks for the traceback: both are raised.
    """
    try:
        return compute()
    except Exception as error:
        if shows_traceback() or isinstance(error, OSError) or isinstance(error.__cause__, OSError):
            raise
        reason = f"{stage} failed: {explained(error)}"
        # each in words of its own, so that none is only counted
        logger.warning(f"the run goes on without: {reason}")
        return Failed(reason)
