"""A rotation measured between two frames some steps apart."""

from __future__ import annotations

from dataclasses import dataclass

from slam.frames import Ends
from slam.geometry.se3 import FloatArray


@dataclass(frozen=True)
class RelativeRotation:
    """The rotation from one frame to another some steps later, measured on these two images alone.

    ``R_to_from`` ``(3, 3)`` takes points of the earlier camera to the axes of the later one; ``sigmas`` ``(3,)`` are
    those of its rotation vector in the later camera, radians.
    """

    from_index: int
    to_index: int
    R_to_from: FloatArray
    sigmas: FloatArray

    @property
    def ends(self) -> Ends:
        """Both frames."""
        return self.from_index, self.to_index
