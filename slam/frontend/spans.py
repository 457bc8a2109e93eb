"""How far the camera went over several steps before a frame, compared with several after it.

Corners that were followed all the way give their depth at the frame in the middle twice, by the way there and by the
way on. Over a single step the two differ by the noise of a small parallax; over several the parallax is several times
as large, and errors of lengths that would add up from step to step are seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.frontend.epipolar import Heading, Structure, triangulated_depth
from slam.se3 import FloatArray, invert

_LEAST_COMMON = 12
_LEAST_PARALLAX = 0.004  # of the focal length
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class SpanRatios:
    """``K`` frames whose spans of ``m`` steps on both sides were compared.

    ``before`` and ``after`` ``(K, m)`` are steps and ``share_before``, ``share_after`` ``(K, m)`` their shares of each
    span; ``excess`` ``(K,)`` is by how much the logarithm of the span before is too large beside the one after, and
    ``sigma`` ``(K,)`` its sigma.
    """

    before: NDArray[np.int64]
    after: NDArray[np.int64]
    share_before: FloatArray
    share_after: FloatArray
    excess: FloatArray
    sigma: FloatArray


def span_ratios(
    structures: Mapping[int, Structure], T_previous_current: Mapping[int, FloatArray], lengths: FloatArray, count: int
) -> SpanRatios:
    """Compare the ``count`` steps before and after every frame that corners join.

    Args:
        structures: of the steps ``k -> k + 1``.
        T_previous_current: of the same steps, of any length.
        lengths: what is believed of all steps ``(S,)``, NaN where nothing is.
        count: of steps in a span.
    """
    found = []
    for middle in structures:
        steps = range(middle - count, middle + count)
        if middle + count not in structures or not all(k in structures and lengths[k] > 0 for k in steps):
            continue
        compared = _compared(structures, T_previous_current, lengths, middle, count)
        if compared is not None:
            found.append((middle, *compared))
    middles = np.array([k for k, _, _ in found], dtype=np.int64)[:, None]
    before, after = middles + np.arange(-count, 0), middles + np.arange(count)
    shares = [lengths[span] / lengths[span].sum(axis=1, keepdims=True) for span in (before, after)]
    return SpanRatios(before, after, *shares, *(np.array([row[n] for row in found]) for n in (1, 2)))


def _compared(
    structures: Mapping[int, Structure],
    T_previous_current: Mapping[int, FloatArray],
    lengths: FloatArray,
    middle: int,
    count: int,
) -> tuple[float, float] | None:
    """Log of the depth by the way there over that by the way on, and its sigma."""
    first, here, last = (structures[middle + n] for n in (-count, 0, count))
    names = np.intersect1d(np.intersect1d(first.names, here.names, assume_unique=True), last.names, assume_unique=True)
    if len(names) < _LEAST_COMMON:
        return None
    rays = [_rays_of(structure, names) for structure in (first, here, last)]
    T_first_middle = _way(T_previous_current, lengths, range(middle - count, middle))
    T_last_middle = invert(_way(T_previous_current, lengths, range(middle, middle + count)))
    depth_there, parallax_there = _depth(rays[1], rays[0], T_first_middle)
    depth_on, parallax_on = _depth(rays[1], rays[2], T_last_middle)
    usable = (depth_there > 0) & (depth_on > 0) & (np.minimum(parallax_there, parallax_on) > _LEAST_PARALLAX)
    if usable.sum() < _LEAST_COMMON:
        return None
    logarithms = np.log(depth_there[usable] / depth_on[usable])
    weights = 1.0 / (parallax_there[usable] ** -2 + parallax_on[usable] ** -2)
    order = np.argsort(logarithms)
    cumulative = np.cumsum(weights[order])
    centre = float(logarithms[order][np.searchsorted(cumulative, cumulative[-1] / 2)])
    deviation = _MAD_TO_SIGMA * float(np.median(np.abs(logarithms - centre)))
    return centre, deviation / float(np.sqrt(usable.sum()))


def _rays_of(structure: Structure, names: NDArray[np.int64]) -> FloatArray:
    """Rays ``(M, 3)`` of corners by their names, which a structure keeps in rising order."""
    order = np.argsort(structure.names)
    rows = order[np.searchsorted(structure.names, names, sorter=order)]
    return np.column_stack([structure.rays_previous[rows], np.ones(len(rows))])


def _way(T_previous_current: Mapping[int, FloatArray], lengths: FloatArray, steps: range) -> FloatArray:
    T = np.eye(4)
    for step in steps:
        T_step = T_previous_current[step].copy()
        T_step[:3, 3] *= lengths[step] / np.linalg.norm(T_step[:3, 3])
        T = T @ T_step
    return T


def _depth(rays: FloatArray, rays_other: FloatArray, T_other_camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    """z-depth ``(M,)`` and the shift ``(M,)`` that the rotation does not explain, in focal lengths."""
    R, t = T_other_camera[:3, :3], T_other_camera[:3, 3]
    way = float(np.linalg.norm(t))
    turned = rays @ R.T
    parallax = np.linalg.norm(turned[:, :2] / turned[:, 2:] - rays_other[:, :2], axis=1)
    return way * triangulated_depth(rays, rays_other, Heading(R, t / way)), parallax
