"""Work spread over processes or machines by Dask (an optional extra)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from types import ModuleType
from typing import Any

from slam.runtime.errors import SlamError
from slam.runtime.imports import import_extra

Spread = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[tuple[int, Any]]]


@contextmanager
def workers(count: int, scheduler: str | None = None, by_value: Sequence[ModuleType] = ()) -> Iterator[Spread]:
    """A map over items that yields ``(number, result)`` as they end.

    Items of a worker that dies are given to another; the result of one that fails is its exception, also where several
    workers died of it.

    Args:
        count: workers on this machine; 1 without a scheduler works here, and needs no Dask.
        scheduler: address of a Dask scheduler, whose workers are used instead.
        by_value: modules that are sent with the work, because workers elsewhere do not have them.

    Raises:
        SlamError: Dask is not installed, or the scheduler does not answer.
    """
    if count == 1 and scheduler is None:
        yield _one_after_another
        return
    cloudpickle, distributed = import_extra("cluster")
    for module in by_value:
        cloudpickle.register_pickle_by_value(module)
    try:
        client = distributed.Client(scheduler, timeout="10s") if scheduler else distributed.Client(**_local(count))
    except (OSError, ValueError) as error:
        raise SlamError(f"no Dask scheduler answers at {scheduler}: {' '.join(str(error).split())}") from error

    def spread(work: Callable[[Any], Any], items: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        packed = [cloudpickle.dumps(partial(work, item)) for item in items]
        futures = client.map(lambda task: cloudpickle.loads(task)(), packed, pure=False)
        numbers = {future.key: number for number, future in enumerate(futures)}
        for future in distributed.as_completed(futures):
            yield numbers[future.key], future.exception() or future.result()

    with client:
        yield spread


def _local(count: int) -> dict[str, Any]:
    """A cluster on this machine; the limit of memory is that of each drive's process, not of Dask's."""
    quiet = {"silence_logs": logging.CRITICAL, "dashboard_address": ":0", "memory_limit": None}
    return {"n_workers": count, "threads_per_worker": 1, **quiet}


def _one_after_another(work: Callable[[Any], Any], items: Sequence[Any]) -> Iterator[tuple[int, Any]]:
    for number, item in enumerate(items):
        try:
            yield number, work(item)
        except Exception as error:
            yield number, error
