"""Frames of a source in a thread of their own, and the drive that grows as they arrive, as a sequence."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from threading import Condition, Event, Thread

import numpy as np

from erfsfm.common.readers.camera_file import CameraFile
from slam.commands.live.source import Source
from slam.frames import Frame, Image
from slam.runtime.errors import SequenceError
from slam.sequences.recording import GrowingSequence
from slam.sequences.undistortion import require_size, undistorted

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
        """Prepare to read; the thread begins with the iteration.

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

    def __iter__(self) -> Iterator[Arrival]:
        self._thread.start()
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
        if self._thread.is_alive():
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


class StreamedSequence(GrowingSequence):
    """The frames that a reader gave so far; ``arrivals`` are the arrival times of the last ones, by frame."""

    def __init__(
        self, name: str, source: Source, camera: CameraFile, most_wait_s: float, every_frame: bool = False
    ) -> None:
        """Prepare to read.

        Raises:
            SequenceError: every frame is wanted of a source that does not wait.
            SequenceError: the camera has another image size than the source.
        """
        require_size(source, camera, name)
        if every_frame and not source.is_stored:
            raise SequenceError(f"{name} does not wait while an image is measured: leave out --every-frame")
        intrinsics, undistortion = undistorted(camera)
        super().__init__(intrinsics, camera.height_or(None), name)
        prepare = undistortion.apply if undistortion is not None else lambda image: image
        self.reader = Reader(source, most_wait_s, prepare, every_frame)
        self.arrivals: dict[int, Arrival] = {}

    def frames(self) -> Iterator[Frame]:
        """Every frame as it is taken."""
        for index, arrival in enumerate(self.reader):
            self.stamps = np.append(self.stamps, arrival.stamp)
            self.arrivals = {k: v for k, v in self.arrivals.items() if k >= index - 2} | {index: arrival}
            arrival.image.setflags(write=False)
            yield Frame(index, arrival.stamp, arrival.image)
