"""The input of each frame: its image, or the reason why there is none, and its depth."""

from __future__ import annotations

import numpy as np

from slam.frames import DepthMap, Frame, Predictor, Sequence
from slam.runtime.errors import SequenceError, SlamError


def read_frame(sequence: Sequence, index: int) -> Frame | SequenceError:
    """A frame, or why its image cannot be read."""
    try:
        frame = sequence.frame(index)
        frame.image.setflags(write=False)
        return frame
    except SequenceError as error:
        return error


def predicted_depth(predictor: Predictor, frame: Frame) -> DepthMap:
    """Depth ``(H, W)`` of a frame.

    Raises:
        SlamError: a user's predictor gives something else.
    """
    depth = predictor.depth(frame)
    wanted, shape, kind = frame.image.shape[:2], np.shape(depth), getattr(depth, "dtype", type(depth).__name__)
    if shape != wanted or kind != np.float32:
        raise SlamError(f"the predictor's depth of frame {frame.index} must be {wanted} float32; got {shape} {kind}")
    return depth
