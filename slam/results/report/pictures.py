"""Images in the report: depth of some keyframes, and accepted loops with corners that both images show."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.frames import Image, Intrinsics
from slam.loops.recognition import Loop
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
            found.append(_picture(narrowed(strip, _WIDTH_PX * (1 + len(depths))), f"Frame {each.frame}"))
        return found


def loop_pictures(loops: Sequence[Loop], image: Callable[[int], Image | None], intrinsics: Intrinsics) -> list[Picture]:
    """Some accepted loops, spread over the drive: both images with lines between the corners that measured the loop.

    Loops of which an image is None, as those of a live drive are, are left out; ``intrinsics`` are of the recording,
    images may be smaller.
    """
    found = []
    ordered = sorted(loops, key=lambda loop: loop.ends[::-1])
    for some in np.array_split(np.arange(len(ordered)), min(_MOST_LOOPS, len(ordered)) or 1):
        best = max((ordered[k] for k in some), key=lambda loop: loop.inliers, default=None)
        if best is not None:
            first, second = (image(index) for index in best.ends)
            if first is not None and second is not None:
                title = f"Frames {best.ends[0]} and {best.ends[1]}: {best.inliers} inliers"
                found.append(_picture(_joined(first, second, best.pixels * (_WIDTH_PX / intrinsics.width)), title))
    return found


def _joined(first: Image, second: Image, ends: NDArray[np.floating]) -> Image:
    """Both images, wide ones below each other, with a line for every corner ``(M, 2, 2)``, some of very many."""
    wide = first.shape[1] > 2 * first.shape[0]
    left, right = narrowed(first, _WIDTH_PX), narrowed(second, _WIDTH_PX)
    joined = np.ascontiguousarray(np.vstack([left, right]) if wide else np.hstack([left, right]))
    shift = np.array([[0, 0], [0, left.shape[0]] if wide else [_WIDTH_PX, 0]])
    ends = (ends + shift)[:: max(1, -(-len(ends) // _MOST_LINES))]
    for k, line in enumerate(np.rint(ends).astype(int).tolist()):
        cv2.line(joined, line[0], line[1], _LINES[k % len(_LINES)], 1, cv2.LINE_AA)
        for place in line:
            cv2.circle(joined, place, 2, _LINES[k % len(_LINES)], 1, cv2.LINE_AA)
    return joined


def narrowed(image: Image, width: int) -> Image:
    """An image at another width."""
    height = max(round(image.shape[0] * width / image.shape[1]), 1)
    method = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=method), np.uint8)


def _picture(image: Image, title: str) -> Picture:
    _, content = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
    return Picture(title, title, f"data:image/jpeg;base64,{base64.b64encode(content.tobytes()).decode('ascii')}")
