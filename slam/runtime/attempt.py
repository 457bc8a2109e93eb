"""Stages that a run can do without."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from erfsfm.common.errors import explained, shows_traceback
from slam.runtime.errors import RunError
from slam.runtime.storage.record import Missing

logger = logging.getLogger(__name__)
T = TypeVar("T")


def attempt(stage: str, compute: Callable[[], T]) -> T | Missing:
    """The result of a stage, or why there is none: an error costs the stage, with a warning that names its place.

    Files that cannot be written concern the whole run, and so does what a user wants to see with its traceback.

    Raises:
        RunError, OSError: of a file.
        Exception: any, with ``ERFSFM_TRACEBACK=1``.
    """
    try:
        return compute()
    except (RunError, OSError):
        raise
    except Exception as error:
        if shows_traceback():
            raise
        failure = Missing(f"{stage} failed: {explained(error)}")
        logger.warning("%s; the run goes on without", failure.reason)
        return failure
