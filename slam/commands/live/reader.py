"""Frames of a source in a thread of their own; they wait for a moment at most, so that nothing falls behind."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from threading import Condition, Event, Thread

from slam.commands.live.source import Source
from slam.frames import Image
from slam.runtime.errors import SequenceError

INTERRUPTED, OVER = "it was interrupted", "the source ended"
EXPECTED = (INTERRUPTED, OVER)
_LAST_IMAGE_S = 2.0
_MOST_LATE_S = 0.15  # an image that waits is dropped for one that was taken later than this: a keyframe takes as long


@dataclass(frozen=True)
class Arrival:
    """An image, its stamp, and when it came by the monotonic clock, seconds."""

    stamp: float
    image: Image
    at_s: float


class Reader:
    """Iterates over the arrivals that were not dropped.

    Attributes:
        dropped: number of images that waited, and were too old when another one came.
        ended: why there are no more, after the last one.
    """

    def __init__(
        self, source: Source, most_wait_s: float, prepare: Callable[[Image], Image], every_frame: bool = False
    ) -> None:
        """Start to read.

        Args:
            source: is read until it ends, dies, or sends nothing for ``most_wait_s``.
            most_wait_s: seconds.
            prepare: what is done with every image that is taken, such as undistortion.
            every_frame: the source waits until each image was taken.
        """
        self.dropped, self.ended = 0, ""
        self._source, self._most_wait_s, self._prepare = source, most_wait_s, prepare
        self._every_frame = every_frame
        self._waiting: deque[Arrival] = deque()
        self._reason: str | None = None
        self._changed, self._stopped = Condition(), Event()
        self._thread = Thread(target=self._read, name="reader", daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[Arrival]:
        while (arrival := self._take()) is not None:
            yield Arrival(arrival.stamp, self._prepare(arrival.image), arrival.at_s)

    @property
    def is_waiting(self) -> bool:
        """Whether an image waits to be taken."""
        return bool(self._waiting)

    def stop(self) -> None:
        """End after the images that wait."""
        self._stopped.set()
        self._end(INTERRUPTED)

    def close(self) -> None:
        """Stop, and wait for the thread: one that still decodes an image when the process ends would abort it."""
        self.stop()
        self._thread.join(_LAST_IMAGE_S)

    def _take(self) -> Arrival | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._reason is not None, self._most_wait_s)
            arrival = self._waiting.popleft() if self._waiting else None
            self._changed.notify()
            if arrival is None:
                self.ended = self._reason or f"nothing came for {self._most_wait_s:g} s"
                self._stopped.set()
            return arrival

    def _read(self) -> None:
        try:
            for stamp, image in self._source.images(self._stopped):
                with self._changed:
                    if self._every_frame:
                        self._changed.wait_for(lambda: not self._waiting or self._stopped.is_set())
                    if self._stopped.is_set():
                        return
                    while self._waiting and stamp - self._waiting[0].stamp > _MOST_LATE_S:
                        self._waiting.popleft()
                        self.dropped += 1
                    self._waiting.append(Arrival(stamp, image, time.monotonic()))
                    self._changed.notify()
            self._end(OVER)
        except SequenceError as error:
            self._end(f"the source died: {error}")

    def _end(self, reason: str) -> None:
        with self._changed:
            self._reason = self._reason or reason
            self._changed.notify()
