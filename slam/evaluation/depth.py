"""Errors of depth maps in metres, as they are: no scale is fitted."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from slam.geometry.robust import median, rms
from slam.runtime.errors import Failed
from slam.runtime.record import Count, Record

LEAST_M, LARGEST_M = 1.0, 80.0
_RANGES_M = LEAST_M, 5.0, 10.0, 20.0, 40.0, LARGEST_M  # between which errors are told apart
COVERAGES = (50, 90, 95)
_NEAR = 0.005  # of the width: pixels this far around tell a smooth surface from a broken one
_SMOOTH = 1.5  # largest ratio of their true depths; a road seen by a car has less up to 45 m
_PIXELS_OF_A_FRAME = 3000
_MOST_FRAMES = 500  # held; of a longer drive every second frame, every fourth, and so on


class DepthMetrics(Record):
    """The object D of ``metrics.json``; ``coverage`` is the share of errors inside so many per cent of the noise.

    ``by_range`` is ``abs_rel`` of true depths in metres: ``1-5``, ``5-10`` and so on; also of ``smooth`` surfaces, and
    of ``broken`` ones, which are outlines, thin things, fences and leaves.
    """

    abs_rel: float | None = None
    median_rel: float | None = None
    rmse_m: float | None = None
    a1: float | None = None
    by_range: dict[str, float] | None = None
    coverage: dict[str, float] | None = None
    frames: Count | None = None


class DepthErrors:
    """Collects the pixels with truth between 1 and 80 m of many frames, of very many evenly spread ones.

    Estimates beyond 80 m, such as of sky at the outline of a roof, count as 80 m: the field's rule (Eigen et al. 2014).
    """

    def __init__(self) -> None:
        self._depths: list[NDArray[np.float32]] = []
        self._frames, self._step = 0, 1

    def add(
        self,
        depth: NDArray[np.floating],
        truth: NDArray[np.floating],
        relative_sigma: NDArray[np.floating] | None = None,
    ) -> None:
        """Add one frame, evenly thinned to 3000 pixels.

        Args:
            depth: estimate ``(H, W)``; where it is not positive or not finite nothing is compared.
            truth: z-depth ``(h, w)`` of any size, 0 where unknown; each pixel is compared with the nearest estimate.
            relative_sigma: sigma of the estimate over it, ``(H, W)``; infinite where nothing was measured, which is not
                compared.
        """
        v, u = np.nonzero((truth >= LEAST_M) & (truth <= LARGEST_M))
        if len(v) == 0:
            return
        is_passed_over = self._frames % self._step != 0
        self._frames += 1
        if is_passed_over:
            return
        thinned = np.linspace(0, len(v) - 1, min(len(v), _PIXELS_OF_A_FRAME)).astype(int)
        v, u = v[thinned], u[thinned]
        (height, width), (true_height, true_width) = depth.shape, truth.shape
        at = (2 * v + 1) * height // (2 * true_height), (2 * u + 1) * width // (2 * true_width)
        sigma = np.full(len(v), np.nan) if relative_sigma is None else relative_sigma[at]
        known = np.isfinite(depth[at]) & (depth[at] > 0) & ~np.isinf(sigma)
        estimate = np.minimum(depth[at], LARGEST_M)
        around = np.ones((2 * round(_NEAR * true_width) + 1,) * 2, np.uint8)
        least = cv2.erode(np.where(truth > 0, truth, np.inf), around)
        is_broken = (cv2.dilate(truth, around) / _SMOOTH > least)[v, u]
        of_frame = np.stack([estimate, truth[v, u], sigma, is_broken])[:, known]
        self._depths.append(of_frame.astype(np.float32))
        if len(self._depths) > _MOST_FRAMES:
            self._depths, self._step = self._depths[::2], 2 * self._step

    def metrics(self) -> DepthMetrics | None:
        """The errors over all pixels; None where no frame had truth."""
        if not any(part.size for part in self._depths):
            return None
        depth, truth, sigma, is_broken = np.concatenate(self._depths, axis=1).astype(np.float64)
        relative = np.abs(depth - truth) / truth
        ratio = np.maximum(depth / truth, truth / depth)
        parts = {"smooth": is_broken == 0, "broken": is_broken > 0}
        for near, far in pairwise(_RANGES_M):
            parts[f"{near:g}-{far:g}"] = (truth >= near) & (truth < far)
        means = {name: float(relative[part].mean()) for name, part in parts.items() if part.any()}
        coverage: dict[str, float] | Failed = Failed("the network states no noise of its depth")
        if not np.isnan(sigma).any():
            errors = np.log(ratio) / sigma
            coverage = {
                str(level): float((errors < ndtri(0.5 + level / 200)).mean()) for level in COVERAGES
            }
        return DepthMetrics.of(
            abs_rel=float(relative.mean()),
            median_rel=median(relative),
            rmse_m=rms(depth - truth),
            a1=float((ratio < 1.25).mean()),
            by_range=means,
            coverage=coverage,
            frames=len(self._depths),
        )
