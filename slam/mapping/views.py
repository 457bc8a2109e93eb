"""Views that colour a submap: the sharpest keyframe of every stretch of a tenth of the fused depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from slam.frames import DepthMap, Image, Intrinsics
from slam.geometry.se3 import FloatArray, invert, rotation_angle
from slam.mapping.filters import DepthFilters, KeyframeDepth, sampled

_STEP = 0.1  # of the largest fused depth
_STEP_DEG = 10.0
_STRIDE = 7  # of the pixels that compare the brightness of two views
_SAME_SURFACE = 0.05  # relative difference of depth
_LEAST_SHARED = 50  # pixels
_DARK = 8.0  # grey levels below which a ratio says little
_BRIGHT = 247.0


@dataclass(frozen=True)
class _Candidate:
    view: KeyframeDepth
    sharpness: float


class ViewChooser:
    """Chooses the views of one submap after the other."""

    def __init__(self, filters: DepthFilters, depth_max_m: float) -> None:
        """Of the camera of these filters; ``depth_max_m`` is the largest fused depth."""
        self._filters, self._step_m = filters, _STEP * depth_max_m
        self._chosen: list[KeyframeDepth] = []
        self._steps: list[float] = []
        self._begin: FloatArray | None = None
        self._best: _Candidate | None = None
        self._last: KeyframeDepth | None = None

    def add(self, view: KeyframeDepth, kept: DepthMap) -> None:
        """A fused frame with the depth that passed the filters."""
        if self._begin is not None and self._is_far(view.T_world_camera, self._begin):
            self._close()
        if self._begin is None:
            self._begin = view.T_world_camera
        sharpness = _sharpness(view.image)
        if self._best is None or sharpness > self._best.sharpness:
            self._best = _Candidate(KeyframeDepth(view.frame, kept, None, view.image, view.T_world_camera), sharpness)

    def take(self, camera: Intrinsics) -> dict[str, Any]:
        """The views since the last call, as fields of a `Submap`."""
        self._close()
        views, steps = self._chosen, self._steps
        self._chosen, self._steps = [], []
        height, width = camera.height, camera.width
        return {
            "T_world_camera": np.array([view.T_world_camera for view in views]).reshape(-1, 4, 4),
            "images": np.array([view.image for view in views], dtype=np.uint8).reshape(-1, height, width, 3),
            "depths": np.array([view.depth for view in views], dtype=np.float16).reshape(-1, height, width),
            "brightness_steps": np.array(steps, dtype=np.float64),
            "camera": np.array([camera.fx, camera.fy, camera.cx, camera.cy]),
        }

    def _close(self) -> None:
        if self._best is not None:
            view = self._best.view
            self._steps.append(np.nan if self._last is None else self._brightness_step(view, self._last))
            self._chosen.append(view)
            self._last = view
        self._begin = self._best = None

    def _is_far(self, T_world_camera: FloatArray, T_world_other: FloatArray) -> bool:
        T_other_camera = invert(T_world_other) @ T_world_camera
        turned = float(rotation_angle(T_other_camera[:3, :3]))
        return float(np.linalg.norm(T_other_camera[:3, 3])) >= self._step_m or turned >= np.deg2rad(_STEP_DEG)

    def _brightness_step(self, view: KeyframeDepth, before: KeyframeDepth) -> float:
        """Logarithm of the brightness of surfaces that two views share, over that in the one before."""
        u, v, z = self._filters.projected(view, before)
        same = np.abs(sampled(before.depth, u, v) - z) < _SAME_SURFACE * z
        here, there = (grey[same][::_STRIDE] for grey in (_grey(view.image), sampled(_grey(before.image), u, v)))
        usable = (np.minimum(here, there) > _DARK) & (np.maximum(here, there) < _BRIGHT)
        if usable.sum() < _LEAST_SHARED:
            return float("nan")
        return float(np.median(np.log(here[usable]) - np.log(there[usable])))


def _grey(image: Image) -> FloatArray:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.float64)


def _sharpness(image: Image) -> float:
    """Variance of the Laplacian over that of the grey levels, so that contrast does not count."""
    grey = _grey(image)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var() / (grey.var() + 1.0))
