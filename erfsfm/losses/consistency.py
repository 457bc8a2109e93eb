"""Agreement of the depth maps of neighbouring frames, which fixes one scale along a drive."""

from __future__ import annotations

from torch import Tensor


def depth_inconsistency(z_source: Tensor, depth_source_sampled: Tensor) -> Tensor:
    """Relative disagreement in [0, 1): ``|a - b| / (a + b)``   (Bian et al. 2019, Eq. 5).

    Args:
        z_source: depth of the target's points in the source camera, ``(B, 1, H, W)``, positive.
        depth_source_sampled: the source's own depth map looked up at their projections, same shape.
    """
    return (z_source - depth_source_sampled).abs() / (z_source + depth_source_sampled)
