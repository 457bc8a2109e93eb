"""A drive that grows as its frames arrive, as a sequence for the pipeline."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from erfsfm.common.readers.camera_file import CAMERA_FILE, CameraFile
from slam.commands.live.reader import Arrival, Reader
from slam.commands.live.source import Source
from slam.frames import Frame
from slam.runtime.errors import SequenceError
from slam.sequences.camera_file import beside, explicit_camera
from slam.sequences.recording import GrowingSequence
from slam.sequences.undistortion import Undistortion, intrinsics_of


class StreamedSequence(GrowingSequence):
    """The frames that a reader gave so far; ``arrivals`` are the arrival times of the last ones, by frame."""

    def __init__(
        self, name: str, source: Source, camera: CameraFile, most_wait_s: float, every_frame: bool = False
    ) -> None:
        """Begin to read.

        Raises:
            SequenceError: every frame is wanted of a source that does not wait.
            SequenceError: the camera has another image size than the source.
        """
        if (camera.width, camera.height) != (source.width, source.height):
            raise SequenceError(
                f"{name} gives images of {source.width} x {source.height} and the camera file is for {camera.width} x "
                f"{camera.height}: give the calibration of this camera at this size"
            )
        if every_frame and not source.is_stored:
            raise SequenceError(f"{name} does not wait while an image is measured: leave out --every-frame")
        undistortion = Undistortion(camera) if camera.is_distorted else None
        super().__init__(intrinsics_of(camera), camera.height_or(None), name=name)
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


def calibration_of(camera: str, given: Path | None, source: Source) -> CameraFile:
    """The calibration given, or the ``camera.yaml`` beside a folder or a video.

    Raises:
        SequenceError: there is none.
    """
    if given is not None:
        return explicit_camera(given, source, source.fps)
    path = Path(camera)
    places = (path, path.absolute().parent) if path.is_dir() else (path.absolute().parent,) if path.is_file() else ()
    found = beside(*places)
    if found is None:
        looked = f"; no {CAMERA_FILE} is in {' or '.join(map(str, places))}" if places else ""
        raise SequenceError(f"{camera} needs its calibration: give --camera {CAMERA_FILE} or fov=70{looked}")
    return found
