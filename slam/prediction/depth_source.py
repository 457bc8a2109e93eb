"""Depth from elsewhere beside the pose network: another network's or from files, in its own unit."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import DepthMap, Frame, Predictor, SnippetPoses
from slam.geometry.robust import mad_sigma
from slam.runtime.errors import SlamError

logger = logging.getLogger(__name__)

Kind = Literal["depth", "disparity"]
Align = Literal["none", "scale", "affine"]
Disparity = NDArray[np.float32]

_COMPARED = 4096  # pixels of both depths that are compared in a frame
_LEAST_COMPARED = 50
_REWEIGHTINGS = 8


class DepthSource(Protocol):
    """Depth of the frames of one sequence in a unit of its own.

    ``name`` is that of the configuration, ``sha256`` that of the content.
    """

    name: str
    sha256: str

    def disparity(self, frame: Frame) -> Disparity:
        """1/depth ``(h, w)`` of any size, NaN where unknown."""


class SourcedPredictor:
    """Depth by a source, snippet poses by the networks, brought to one unit in each frame.

    The networks' own depth is the link: it has the unit of their poses.
    """

    def __init__(self, networks: Predictor, source: DepthSource, align: Align) -> None:
        """Combine both.

        Args:
            networks: depth and snippet poses in one unit.
            source: depth to use.
            align: ``none`` keeps the source's unit, which must be the same in all frames, and scales the poses to it;
                ``scale`` brings each frame's depth to the networks' unit; ``affine`` fits a shift of disparity as well.
        """
        self._networks = networks
        self._source = source
        self._align = align
        self._key = object()
        self.sources = networks.sources

    def executor(self) -> Executor:
        """That of the networks."""
        return self._networks.executor()

    def depth(self, frame: Frame) -> DepthMap:
        """Z-depth ``(H, W)`` at the image's size, NaN where unknown."""
        depth, unit = self._aligned(frame)
        if np.isnan(unit):
            logger.warning("frame %d has no known depth in %s", frame.index, self._source.name)
        return depth

    def snippet(self, frames: Sequence[Frame]) -> SnippetPoses:
        """Poses of the sources of a snippet in the unit of the target's depth, or the nearest known frame's.

        Raises:
            SlamError: no frame of the snippet has known depth.
        """
        snippet = self._networks.snippet(list(frames))
        if self._align != "none":
            return snippet
        by_distance = sorted(frames, key=lambda frame: (abs(frame.index - snippet.target), -frame.index))
        units = (self._aligned(frame)[1] for frame in by_distance)
        unit = next((unit for unit in units if not np.isnan(unit)), None)
        if unit is None:
            raise SlamError(
                f"frames {frames[0].index} to {frames[-1].index} have no known depth in {self._source.name} (zero, "
                "negative or not finite): check depth.kind and depth.source"
            )
        T_source_target = snippet.T_source_target.copy()
        T_source_target[:, :3, 3] *= unit
        return replace(snippet, T_source_target=T_source_target)

    def _aligned(self, frame: Frame) -> tuple[DepthMap, float]:
        """Depth ``(H, W)``, and the source's unaligned depth over the networks', NaN where unknown."""
        return frame.derived((self._key, "aligned"), lambda: self._align_to_networks(frame))

    def _align_to_networks(self, frame: Frame) -> tuple[DepthMap, float]:
        height, width = frame.image.shape[:2]
        disparity = self._source.disparity(frame)
        disparity = at_size(disparity, height, width)
        step = max(int(np.sqrt(height * width / _COMPARED)), 1)
        own, wanted = (map_[::step, ::step].astype(np.float64) for map_ in (disparity, 1 / self._networks.depth(frame)))
        known = np.isfinite(own)
        own, wanted = own[known], wanted[known]
        if len(own) < _LEAST_COMPARED:
            return np.full((height, width), np.nan, np.float32), np.nan
        near = wanted >= np.median(wanted)  # the half whose depth both know best
        unit = float(np.exp(np.median(np.log(wanted[near] / own[near]))))
        if self._align == "affine":
            gain, shift = _affine(own, wanted, unit)
            disparity = known_only(gain * disparity + shift)
        elif self._align == "scale":
            disparity = disparity * np.float32(unit)
        return np.asarray(1 / disparity, np.float32), unit


def known_only(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Depth or disparity in single precision, NaN where it is not finite or not positive."""
    with np.errstate(over="ignore"):
        single = np.asarray(values, dtype=np.float32)
    tiny = np.finfo(np.float32).tiny  # whose inverse is finite
    return np.where(np.isfinite(single) & (single >= tiny), single, np.float32(np.nan))


def disparity_of(values: NDArray[np.floating], kind: Kind) -> Disparity:
    """Disparity, NaN where unknown, from depth or disparity."""
    known = known_only(values)
    return known if kind == "disparity" else known_only(1 / known)


def at_size(disparity: Disparity, height: int, width: int) -> Disparity:
    """Disparity ``(height, width)`` from one of any size; unknown pixels are left out of the interpolation."""
    if disparity.shape == (height, width):
        return disparity
    known = np.isfinite(disparity)
    if known.all():
        return np.asarray(cv2.resize(disparity, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    shrinks = disparity.shape[0] >= height and disparity.shape[1] >= width
    method, least = (cv2.INTER_AREA, 1e-3) if shrinks else (cv2.INTER_LINEAR, 0.5)
    weight, total = (
        cv2.resize(part.astype(np.float32), (width, height), interpolation=method)
        for part in (known, np.where(known, disparity, 0))
    )
    return np.where(weight >= least, total / np.maximum(weight, least), np.float32(np.nan)).astype(np.float32)


def _affine(own: NDArray[np.float64], wanted: NDArray[np.float64], gain: float) -> tuple[np.float32, np.float32]:
    """Gain and shift from ``own`` to ``wanted`` disparity, by least squares with Cauchy weights.

    Where they would turn near into far, only a gain is fitted.
    """
    columns = np.stack([own, np.ones_like(own)], axis=1)
    fitted = np.array([gain, 0.0])
    for _ in range(_REWEIGHTINGS):
        residual = columns @ fitted - wanted
        sigma = max(mad_sigma(residual), 1e-12)
        weighted = columns / (1 + (residual / (2 * sigma)) ** 2)[:, None]
        fitted = np.linalg.lstsq(weighted.T @ columns, weighted.T @ wanted, rcond=None)[0]
    if fitted[0] <= 0:
        fitted = np.array([gain, 0.0])
    return np.float32(fitted[0]), np.float32(fitted[1])
