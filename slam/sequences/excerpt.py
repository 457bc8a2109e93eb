"""A range of a sequence's frames, as a sequence of its own."""

from __future__ import annotations

from typing import Protocol, cast

from slam.frames import Frame, Sequence
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.recording import RecordedSequence, Source, labels, require_frame
from slam.sequences.undistortion import UndistortedImages, Undistortion


class SourcedSequence(Sequence, Protocol):
    """A sequence with the recordings that it was cut from."""

    sources: tuple[Source, ...]

    def true_poses(self, start: int, stop: int) -> FloatArray | None:
        """``T_world_camera`` of the frames [start, stop), their first the world; None unless all are known."""


class Excerpt:
    """Frames [start, stop) of a sequence, numbered from 0; stamps stay, poses begin at the identity."""

    def __init__(self, base: SourcedSequence, start: int, stop: int) -> None:
        """Cut a sequence.

        Raises:
            SequenceError: unless 0 <= start < stop <= len(base).
        """
        if not 0 <= start < stop <= len(base):
            raise SequenceError(f"no frames {start}:{stop} in sequence {base.name}: it has {len(base)}")
        self.base, self.start, self.stop = base, start, stop
        self.name = base.name
        self.intrinsics = base.intrinsics
        self.stamps = base.stamps[start:stop]
        self.reference = base.true_poses(start, stop)
        self.camera_height_m = base.camera_height_m
        self.T_camera_lidar = base.T_camera_lidar
        self.sources = tuple(source.shifted(start) for source in base.sources)

    def __len__(self) -> int:
        """Number of frames."""
        return self.stop - self.start

    def frame(self, index: int) -> Frame:
        """Read one frame; ``SequenceError`` where its image cannot be read."""
        require_frame(f"{self.name}[{self.start}:{self.stop}]", index, len(self))
        frame = self.base.frame(self.start + index)
        return Frame(index, frame.stamp, frame.image)

    def has_scan(self, index: int) -> bool:
        """Whether a LiDAR scan was taken with a frame."""
        return self.base.has_scan(self.start + index)

    def scan(self, index: int) -> FloatArray:
        """The points ``(P, 3)`` of a frame's scan, metres, in the LiDAR."""
        return self.base.scan(self.start + index)

    def true_poses(self, start: int, stop: int) -> FloatArray | None:
        """``T_world_camera`` of the frames [start, stop), their first the world; None unless all are known."""
        return self.base.true_poses(self.start + start, self.start + stop)

    def provenance(self) -> tuple[str, ...]:
        """Names of the recordings, as in the leak record of a checkpoint."""
        return labels(self.sources, len(self))


def recording_of(sequence: Sequence) -> tuple[Sequence, int]:
    """The recording of a sequence, and which frame of it frame 0 is."""
    return (sequence.base, sequence.start) if isinstance(sequence, Excerpt) else (sequence, 0)


def first_frames(sequence: Sequence, count: int) -> Excerpt:
    """The first frames of a recording, or of an excerpt."""
    base, start = recording_of(sequence)
    return Excerpt(cast("SourcedSequence", base), start, start + count)


def undistortion_of(recording: Sequence) -> Undistortion | None:
    """What a recording does with its images as it reads them; None where they have no distortion."""
    base, _ = recording_of(recording)
    images = base.images if isinstance(base, RecordedSequence) else None
    return images.undistortion if isinstance(images, UndistortedImages) else None


def frame_range(text: str, frames: int) -> tuple[int, int]:
    """Read ``A:B`` as Python reads a slice of so many frames: half-open, either end optional or negative.

    Unlike in Python, an end beyond the sequence is an error.

    Raises:
        SequenceError: if the text is no range, or the range is empty or reaches outside the sequence.
    """
    parts = text.strip().split(":")
    try:
        if len(parts) != 2:
            raise ValueError
        start = int(parts[0]) if parts[0].strip() else 0
        stop = int(parts[1]) if parts[1].strip() else frames
    except ValueError:
        raise SequenceError(f"--frames {text!r} is not a range: write A:B, such as 0:300 or 100:") from None
    first = start + frames if start < 0 else start
    last = stop + frames if stop < 0 else stop
    if not (0 <= first < frames and 0 <= last <= frames):
        raise SequenceError(
            f"--frames {text} reaches outside the sequence: it has {frames} frames; choose within 0:{frames}"
        )
    if first >= last:
        raise SequenceError(f"--frames {text} holds no frames: A must come before B in A:B")
    return first, last
