"""A sequence without images, whose frames come one at a time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from slam.frames import Frame, Intrinsics
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SlamError


@dataclass
class GrowingSequence:
    """A sequence that grows by a frame at a time; its images are not kept."""

    intrinsics: Intrinsics
    camera_height_m: float | None
    stamps: FloatArray = field(default_factory=lambda: np.zeros(0))
    name: str = "live"
    reference: FloatArray | None = None
    T_camera_lidar: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.stamps)

    def frame(self, index: int) -> Frame:
        """Always ``SlamError``: images are not kept."""
        raise SlamError(f"frame {index} of a live drive is not kept")

    def has_scan(self, index: int) -> bool:
        """False: there are no scans."""
        return False

    def scan(self, index: int) -> FloatArray:
        """Always ``SlamError``: there are no scans."""
        raise SlamError(f"frame {index} of a live drive has no scan")

    def provenance(self) -> tuple[str, ...]:
        """Unknown."""
        return ()
