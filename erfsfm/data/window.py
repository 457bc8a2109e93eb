"""Windows of consecutive frames; a file that cannot be read costs the windows that hold it, not a night of training."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.data.array_cache import ImageCache
from erfsfm.data.recordings import Recording

logger = logging.getLogger(__name__)

_MOST_IN_A_ROW = 20
_MOST_NAMED = 10

T = TypeVar("T")


@dataclass(frozen=True)
class Snippet:
    """A window: frames ``first`` to ``first + length - 1`` of a recording."""

    recording: Recording
    first: int


class SnippetReader:
    """Reads snippets and passes over those that cannot be read; each reason is logged once, the first ten of them."""

    def __init__(self) -> None:
        self._named: set[str] = set()

    def first_readable(self, snippets: Iterator[Snippet], read: Callable[[Snippet], T]) -> tuple[Snippet, T]:
        """The first snippet that can be read, and what was read of it.

        Raises:
            DataError: 20 in a row cannot.
        """
        for _ in range(_MOST_IN_A_ROW):
            snippet = next(snippets)
            try:
                return snippet, read(snippet)
            except DataError as error:
                reason = str(error)
                self._name(reason)
        raise DataError(f"{_MOST_IN_A_ROW} snippets in a row cannot be read, the last: {reason}")

    def _name(self, reason: str) -> None:
        if reason in self._named or len(self._named) >= _MOST_NAMED:
            return
        self._named.add(reason)
        more = "; more files are not named" if len(self._named) == _MOST_NAMED else ""
        logger.warning("%s: snippets with it are passed over%s", reason, more)


def load_window(cache: ImageCache, snippet: Snippet, length: int) -> list[NDArray[np.uint8]]:
    """The images of a snippet at the networks' size, in time order."""
    return [cache.image(snippet.recording, snippet.first + k) for k in range(length)]


def readable(snippets: list[Snippet], read: Callable[[Snippet], object]) -> list[Snippet]:
    """The snippets that can be read; of the others one warning.

    Raises:
        DataError: none can.
    """
    kept, reasons = [], []
    for snippet in snippets:
        try:
            read(snippet)
            kept.append(snippet)
        except DataError as error:
            reasons.append(str(error))
    if reasons and not kept:
        raise DataError(f"no snippet to validate on can be read: {reasons[0]}")
    if reasons:
        logger.warning(
            "%d of %d snippets to validate on cannot be read and are left out: %s",
            len(reasons),
            len(snippets),
            reasons[0],
        )
    return kept
