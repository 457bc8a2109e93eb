"""Answers of the networks kept on disk, so that a run with other settings of the graph need not ask them again.

An entry is named by the networks and the bytes and size of every image. Disparity is kept as the network gave it, at
its own size and precision.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from slam.frames import Image
from slam.prediction.networks import Networks
from slam.storage.cache import CacheNamespace, DiskCache


class CachedNetworks:
    """Networks that are asked once for each image and snippet; everything else is read."""

    def __init__(self, networks: Networks, identity: str, memory: DiskCache) -> None:
        """Remember what networks answer.

        Args:
            networks: whom to ask.
            identity: everything that decides their answer beside the images: weights, size, kind of device.
            memory: shared by any number of networks and sequences.
        """
        self.sources = networks.sources
        self._networks = networks
        self._known = CacheNamespace(memory, identity)

    @property
    def found(self) -> int:
        """Answers that were read."""
        return self._known.found

    @property
    def asked(self) -> int:
        """Answers that the networks had to give."""
        return self._known.asked

    def disparity(self, image: Image) -> NDArray[np.float32]:
        """Unscaled 1/depth ``(h, w)`` of an image, at the networks' own size."""
        (disparity,) = self._known.get_or_compute("disparity", [image], lambda: (self._networks.disparity(image),))
        return disparity

    def poses(self, images: Sequence[Image]) -> NDArray[np.float64]:
        """``T_source_target`` ``(N, 4, 4)`` of N + 1 images in time order, the target in the middle."""
        (poses,) = self._known.get_or_compute("poses", images, lambda: (self._networks.poses(images),))
        return poses
