"""Stages that a run can do without."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from erfsfm.common.errors import explained, shows_traceback

logger = logging.getLogger(__name__)
T = TypeVar("T")


@dataclass(frozen=True)
class Failed:
    """Why a stage has no result."""

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
        logger.warning(f"the run goes on without: {reason}")  # each in words of its own, so that none is only counted
        return Failed(reason)
