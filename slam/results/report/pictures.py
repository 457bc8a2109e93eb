"""Images in the report: depth of some keyframes, and accepted loops with corners that both images show."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import DepthMap, Image, Intrinsics, View
from slam.geometry.se3 import FloatArray
from slam.loops.descriptors import FeatureExtractor
from slam.loops.thresholds import LoopThresholds
from slam.loops.verification import Loop, matches
from slam.mapping.filters import KeyframeDepth
from slam.results.report.rendering import Picture

_EXAMPLES, _MOST_LOOPS, _MOST_LINES = 5, 6, 60
_WIDTH_PX = 480
_UNKNOWN = (166, 160, 154)  # BGR
_LINES = ((178, 114, 0), (0, 159, 230), (115, 158, 0), (167, 121, 204), (0, 94, 213))


class DepthPictures:
    """Keeps keyframes evenly spread over a drive while the map is fused: the first from each of five places on."""

    def __init__(self, frames: int) -> None:
        """``frames`` of the drive."""
        self._places = np.linspace(0, frames, _EXAMPLES + 2)[1:-1].tolist()
        self._kept: list[KeyframeDepth] = []

    def add(self, keyframe: KeyframeDepth) -> None:
        """Offer the next keyframe."""
        if self._places and keyframe.frame >= self._places[0]:
            self._kept.append(keyframe)
            self._places = [place for place in self._places if place > keyframe.frame]

    def pictures(self) -> list[Picture]:
        """A strip each: the image, learned depth and refined depth, near in yellow, one colour scale for all."""
        limits = _limits([each.depth for each in self._kept])
        found = []
        for each in self._kept:
            learned = each.depth if each.network_depth is None else each.network_depth
            depths = [learned] if each.relative_sigma is None else [learned, each.depth]
            strip = [_bgr(each.image), *(_coloured(depth, limits) for depth in depths)]
            found.append(_picture(np.hstack([_narrow(part) for part in strip]), f"Frame {each.frame}"))
        return found


def loop_pictures(
    loops: Sequence[Loop], image: Callable[[int], Image | None], intrinsics: Intrinsics, thresholds: LoopThresholds
) -> list[Picture]:
    """Some loops, spread over the drive: both images with the corners that match under the measured motion.

    Args:
        loops: accepted ones.
        image: of a frame; None where it is gone, as those of a live drive are. Such loops are left out.
        intrinsics: of the recording; images may be smaller.
        thresholds: of matches.
    """
    found = []
    ordered = sorted(loops, key=lambda loop: loop.ends[::-1])
    for some in np.array_split(np.arange(len(ordered)), min(_MOST_LOOPS, len(ordered)) or 1):
        best = max((ordered[k] for k in some), key=lambda loop: loop.inliers, default=None)
        if best is not None:
            first, second = (image(index) for index in best.ends)
            if first is not None and second is not None:
                found.append(_pair(best, first, second, intrinsics, thresholds))
    return found


def _pair(loop: Loop, first: Image, second: Image, intrinsics: Intrinsics, thresholds: LoopThresholds) -> Picture:
    views = []
    for index, image in zip(loop.ends, (first, second)):
        camera = intrinsics.resized(image.shape[1], image.shape[0])
        pixels, descriptors = FeatureExtractor(camera).corners(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        views.append((camera, View(index, pixels, descriptors, np.empty((0, 3), np.float32))))
    (camera_first, view_first), (camera_second, view_second) = views
    rows_first, rows_second = matches(view_first, view_second, thresholds)
    from_, to = view_first.pixels[rows_first], view_second.pixels[rows_second]
    off = _off_epipolar(loop.measured.T_from_to, camera_first.rays(from_), camera_second.rays(to))
    kept = off * camera_first.fx < thresholds.reprojection_px
    drawn = np.flatnonzero(kept)[:: max(1, -(-int(kept.sum()) // _MOST_LINES))]
    title = f"Frames {loop.ends[0]} and {loop.ends[1]}: {loop.inliers} inliers"
    return _picture(_joined(first, second, from_[drawn], to[drawn]), title)


def _off_epipolar(T_first_second: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Sampson distances ``(M,)`` of rays ``(M, 3)`` with z = 1 from their epipolar lines."""
    x, y, z = T_first_second[:3, 3] / max(float(np.linalg.norm(T_first_second[:3, 3])), 1e-12)
    E = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ T_first_second[:3, :3]
    lines_first, lines_second = second @ E.T, first @ E
    gradient = (lines_first[:, :2] ** 2).sum(axis=1) + (lines_second[:, :2] ** 2).sum(axis=1)
    error: FloatArray = np.abs((first * lines_first).sum(axis=1)) / np.sqrt(np.maximum(gradient, 1e-12))
    return error


def _joined(first: Image, second: Image, from_: NDArray[np.float32], to: NDArray[np.float32]) -> Image:
    """Both images, wide ones below each other, with a line for every corner ``(M, 2)``."""
    wide = first.shape[1] > 2 * first.shape[0]
    above, below = _narrow(_bgr(first)), _narrow(_bgr(second))
    shift = np.array([0, above.shape[0]] if wide else [above.shape[1], 0])
    joined = np.ascontiguousarray(np.vstack([above, below]) if wide else np.hstack([above, below]))
    starts = np.rint(from_ * (above.shape[1] / first.shape[1])).astype(int)
    ends = np.rint(to * (below.shape[1] / second.shape[1])).astype(int) + shift
    for k, (start, end) in enumerate(zip(starts.tolist(), ends.tolist())):
        colour = _LINES[k % len(_LINES)]
        cv2.line(joined, start, end, colour, 1, cv2.LINE_AA)
        for place in (start, end):
            cv2.circle(joined, place, 2, colour, 1, cv2.LINE_AA)
    return joined


def _limits(depths: Sequence[DepthMap]) -> tuple[float, float]:
    """Disparities between which colours change."""
    known = [1.0 / depth[_is_known(depth)] for depth in depths]
    seen = np.concatenate(known) if known else np.zeros(0)
    low, high = np.percentile(seen, [2, 98]) if seen.size else (0.0, 1.0)
    return float(low), max(float(high - low), 1e-9)


def _coloured(depth: DepthMap, limits: tuple[float, float]) -> Image:
    """1 / depth in colours, BGR: near in yellow, far in black, grey where it is unknown."""
    is_known = _is_known(depth)
    share = (1.0 / np.where(is_known, depth, 1.0) - limits[0]) / limits[1]
    coloured = cv2.applyColorMap(np.clip(255.0 * share, 0.0, 255.0).astype(np.uint8), cv2.COLORMAP_INFERNO)
    return np.where(is_known[..., None], coloured, np.array(_UNKNOWN, np.uint8))


def _is_known(depth: DepthMap) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(depth) & (depth > 0))


def _narrow(image: Image) -> Image:
    height, width = image.shape[:2]
    size = (_WIDTH_PX, max(round(height * _WIDTH_PX / width), 1))
    method = cv2.INTER_AREA if width > _WIDTH_PX else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=method), np.uint8)


def _bgr(image: Image) -> Image:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), np.uint8)


def _picture(bgr: Image, title: str) -> Picture:
    written, content = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 82])
    if not written:
        return Picture(title, title, reason="it cannot be written as JPEG")
    return Picture.of_file(title, title, content.tobytes(), "jpeg")
