"""The unit of a map by learned depth."""

from __future__ import annotations

import numpy as np

from slam.frontend.keyframes.local_map import LocalMap, TrackedKeyframe
from slam.geometry.se3 import FloatArray, apply

_LEAST_DEPTHS = 20


def learned_unit(local: LocalMap) -> float:
    """Learned depth over depth in the map, the median over all sightings by keyframes; 1 where there are few."""
    joined = np.concatenate([_ratios(local, keyframe) for keyframe in local.keyframes])
    return float(np.median(joined)) if len(joined) >= _LEAST_DEPTHS else 1.0


def _ratios(local: LocalMap, keyframe: TrackedKeyframe) -> FloatArray:
    """Learned depth over depth in the map at the corners of a keyframe where both are known."""
    depth = apply(keyframe.T_camera_world, local.points[keyframe.track_ids])[:, 2]
    with np.errstate(invalid="ignore"):
        ratio = keyframe.learned_depth / depth
    return np.asarray(ratio[np.isfinite(ratio) & (ratio > 0)])
