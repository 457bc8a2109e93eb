"""Views of a board: which images show it, and which of them together say most about the camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from erfsfm.common.progress import Progress
from slam.commands.calibration.board import Board, Detector
from slam.frames import Grey, Image
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import CalibrationError
from slam.sequences.images import ImageSource

MOST_VIEWS = 40
FEWEST_VIEWS = 8
_MOST_SEARCHED = 300  # images of a video
_MOST_PROBED = 20
_BLURRED = 0.3  # of the median sharpness


@dataclass(frozen=True, eq=False)
class View:
    """An image of a board.

    Attributes:
        frame: its number.
        pixels: the corners ``(N, 2)``.
        corners_m: the same on the board ``(N, 3)``.
        sharpness: variance of the Laplacian on the board over the variance of its grey levels.
        place: where and how the board is seen ``(5,)``: its middle, its size and its tilt about both axes.
    """

    frame: int
    pixels: FloatArray
    corners_m: FloatArray
    sharpness: float
    place: FloatArray


def find_views(images: ImageSource, board: Board, progress: Progress) -> list[View]:
    """All views of a board, of a long video in every n-th image.

    Raises:
        CalibrationError: too few images show the board; it says why where that can be told.
        DataError, SequenceError: an image cannot be read.
    """
    detector = Detector(board)
    step = -(-len(images) // _MOST_SEARCHED)
    frames = range(0, len(images), step)
    views, without = [], []
    for count, frame in enumerate(frames, start=1):
        grey = _grey(images.read(frame))
        found = detector.find(grey)
        if found is None:
            without.append(frame)
        else:
            views.append(_view(frame, grey, *found))
        progress("images", count, len(frames))
    if len(views) < FEWEST_VIEWS:
        probed = without[:: -(-len(without) // _MOST_PROBED)] if without else []
        parts = sum(detector.sees_part(_grey(images.read(frame))) for frame in probed)
        raise CalibrationError(_too_few(board, len(views), len(frames), parts, len(probed)))
    return views


def chosen(views: list[View]) -> list[View]:
    """At most 40 views that differ most from each other, sharp ones first, in the order of time.

    The next is always the one whose place is furthest from those of all before, times its sharpness' rank.
    """
    median = float(np.median([view.sharpness for view in views]))
    sharp = [view for view in views if view.sharpness >= _BLURRED * median]
    if len(sharp) <= MOST_VIEWS:
        return sharp
    ranks = np.argsort(np.argsort([view.sharpness for view in sharp])) / (len(sharp) - 1)
    places = np.array([view.place for view in sharp])
    taken = [int(np.argmax(ranks))]
    distances = np.full(len(sharp), np.inf)
    while len(taken) < MOST_VIEWS:
        distances = np.minimum(distances, np.linalg.norm(places - places[taken[-1]], axis=1))
        taken.append(int(np.argmax(distances * (1 + ranks))))
    return [sharp[k] for k in sorted(set(taken))]


def _view(frame: int, grey: Grey, pixels: FloatArray, corners_m: FloatArray) -> View:
    height, width = grey.shape
    hull = cv2.convexHull(pixels.astype(np.float32))
    mask = cv2.fillConvexPoly(np.zeros_like(grey), np.rint(hull).astype(np.int32), 255) > 0
    sharpness = float(cv2.Laplacian(grey, cv2.CV_64F)[mask].var() / max(float(grey[mask].var()), 1.0))
    extent = np.ptp(corners_m[:, :2], axis=0)
    plane = (corners_m[:, :2] - corners_m[:, :2].mean(axis=0)) / extent
    homography, _ = cv2.findHomography(plane, pixels / width)
    tilt = np.zeros(2) if homography is None else homography[2, :2] / homography[2, 2]
    middle = pixels.mean(axis=0) / [width, height]
    size = np.sqrt(cv2.contourArea(hull) / (width * height))
    return View(frame, pixels, corners_m, sharpness, np.array([*middle, size, *tilt]))


def _grey(image: Image) -> Grey:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def _too_few(board: Board, found: int, searched: int, parts: int, probed: int) -> str:
    said = f"{found} of {searched} images show the whole {board.describe()}, {FEWEST_VIEWS} are needed"
    if parts * 2 > probed:
        return (
            f"{said}; others show a part of a chessboard: keep all of it in the image, or count the corners between "
            f"its squares again for --board"
        )
    wanted = "20 or more sharp images of the board at many places and tilts"
    return f"{said}: take {wanted}, and check --board and --pattern"
