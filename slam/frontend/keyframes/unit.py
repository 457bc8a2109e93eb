"""The unit of a map by learned depth."""

from __future__ import annotations

import numpy as np

from slam.frontend.keyframes.local_map import LocalMap

_LEAST_DEPTHS = 20


def learned_unit(local: LocalMap) -> float:
    """Learned depth over depth in the map, the median over all sightings by keyframes; 1 where there are few."""
    joined = np.concatenate([local.ratios(keyframe) for keyframe in local.keyframes])
    known = joined[joined > 0.0]
    return float(np.median(1.0 / known)) if len(known) >= _LEAST_DEPTHS else 1.0
