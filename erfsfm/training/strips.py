"""Images with a strip of another one: streets that no camera has passed (CutMix, Yun et al. 2019, with depth)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

NARROWEST, WIDEST = 0.15, 0.6  # of a strip, in widths of the image
_MIXED = ("target", "least", "most")


def with_strips(batch: dict[str, Tensor], chance: float, rng: np.random.Generator) -> dict[str, Tensor]:
    """The batch with upright strips of its images, and of their labels, in some of its other images.

    Seen by the reference camera, depths of all images have one unit, so that a mixture has a depth map. Its two parts
    have the same rows and columns as before: the road stays below and the sky above.

    Args:
        batch: ``target`` ``(B, 3, H, W)`` and its bounds ``least`` and ``most`` ``(B, 1, H, W)``.
        chance: that an image gets a strip.
        rng: of all random draws.
    """
    target = batch["target"]
    count, width = len(target), target.shape[-1]
    others = torch.from_numpy(rng.permutation(count)).to(target.device)
    share = rng.uniform(NARROWEST, WIDEST, count)
    first = rng.uniform(0, 1 - share) * width
    last = np.where(rng.random(count) < chance, first + share * width, -1)
    columns = np.arange(width)
    inside = (columns >= first[:, None]) & (columns < last[:, None])
    inside_there = torch.from_numpy(inside[:, None, None]).to(target.device)
    return batch | {name: torch.where(inside_there, batch[name][others], batch[name]) for name in _MIXED}
