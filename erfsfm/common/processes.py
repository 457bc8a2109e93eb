"""Work spread over processes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from erfsfm.common.errors import TrainingError
from erfsfm.common.threads import stay_single_threaded


@contextmanager
def processes(work: str) -> Iterator[ProcessPoolExecutor]:
    """As many processes as there are cores, each of one thread; after an error, what they have not begun is left.

    Raises:
        TrainingError: one of them, which ``work`` describes, was killed.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), context, stay_single_threaded) as pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            raise TrainingError(f"a process that {work} was killed: is there enough memory?") from error
        finally:
            pool.shutdown(cancel_futures=True)
