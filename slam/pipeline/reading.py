"""Reading the frames of a sequence one by one."""

from __future__ import annotations

from slam.errors import SequenceError
from slam.frames import Frame, Sequence


def read_frame(sequence: Sequence, index: int) -> Frame | SequenceError:
    """A frame, or why its image cannot be read."""
    try:
        frame = sequence.frame(index)
        frame.image.setflags(write=False)
        return frame
    except SequenceError as error:
        return error
