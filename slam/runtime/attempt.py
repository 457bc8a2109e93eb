"""Stages that a run can do without."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from erfsfm.common.errors import explained, shows_traceback
from slam.runtime.storage.record import Missing

logger = logging.getLogger(__name__)
T = TypeVar("T")


def attempt(stage: str, compute: Callable[[], T]) -> T | Missing:
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
        return Missing(reason)
