"""Images in the report: depth of some keyframes, and accepted loops with corners that both images show."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Image, Intrinsics, View
from slam.frontend.visual.residuals import Residuals
from slam.geometry.epipolar import UnitRelativePose
from slam.geometry.se3 import invert
from slam.loops.descriptors import FeatureExtractor
from slam.loops.verification import Loop, LoopThresholds, matches
from slam.mapping.filters import KeyframeDepth
from slam.results.report.page import Picture

_EXAMPLES, _MOST_LOOPS, _MOST_LINES = 5, 6, 60
_WIDTH_PX = 480
_LINES = ((0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (213, 94, 0))


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
        """A strip each: the image, learned depth and refined depth, near in yellow, in one colour scale."""
        from erfsfm.inference import colour_disparity

        found = []
        for each in self._kept:
            learned = each.depth if each.network_depth is None else each.network_depth
            depths = [learned] if each.relative_sigma is None else [learned, each.depth]
            strip = np.hstack([each.image, colour_disparity(np.hstack(depths))])
            found.append(_picture(_narrow(strip, _WIDTH_PX * (1 + len(depths))), f"Frame {each.frame}"))
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
    T_second_first = invert(loop.measured.T_from_to)
    motion = UnitRelativePose(T_second_first[:3, :3], T_second_first[:3, 3])  # of any length
    rays_first, rays_second = camera_first.rays(from_), camera_second.rays(to)
    residuals = Residuals(rays_first, rays_second, np.full(len(from_), np.nan), camera_first.fx)
    kept = np.abs(residuals.across(motion, np.eye(3, 2))[0]) < thresholds.reprojection_px
    drawn = np.flatnonzero(kept)[:: max(1, -(-int(kept.sum()) // _MOST_LINES))]
    title = f"Frames {loop.ends[0]} and {loop.ends[1]}: {loop.inliers} inliers"
    return _picture(_joined(first, second, from_[drawn], to[drawn]), title)


def _joined(first: Image, second: Image, from_: NDArray[np.float32], to: NDArray[np.float32]) -> Image:
    """Both images, wide ones below each other, with a line for every corner ``(M, 2)``."""
    wide = first.shape[1] > 2 * first.shape[0]
    left, right = _narrow(first, _WIDTH_PX), _narrow(second, _WIDTH_PX)
    joined = np.ascontiguousarray(np.vstack([left, right]) if wide else np.hstack([left, right]))
    starts = from_ * (_WIDTH_PX / first.shape[1])
    ends = to * (_WIDTH_PX / second.shape[1]) + ([0, left.shape[0]] if wide else [_WIDTH_PX, 0])
    for k, line in enumerate(np.rint(np.stack([starts, ends], axis=1)).astype(int).tolist()):
        cv2.line(joined, line[0], line[1], _LINES[k % len(_LINES)], 1, cv2.LINE_AA)
        for place in line:
            cv2.circle(joined, place, 2, _LINES[k % len(_LINES)], 1, cv2.LINE_AA)
    return joined


def _narrow(image: Image, width: int) -> Image:
    height = max(round(image.shape[0] * width / image.shape[1]), 1)
    method = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=method), np.uint8)


def _picture(image: Image, title: str) -> Picture:
    _, content = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
    return Picture.of_file(title, title, content.tobytes(), "jpeg")
