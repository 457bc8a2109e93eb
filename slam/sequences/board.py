"""A calibration board and its views in images: corners found, and the views that say most of a camera."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from scipy.spatial.distance import pdist

from erfsfm.common.progress import Progress
from slam.frames import Grey
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SlamError
from slam.sequences.images import ImageSource

Pattern = Literal["chessboard", "charuco"]

_BOARD = re.compile(r"(\d+)x(\d+)")
_FEWEST = 3  # corners along one side
_LEAST_CHARUCO = 12  # corners of a view: more than a homography needs
_WINDOW, _MOST_HALF_WINDOW_PX = 0.2, 11  # of the distance to the next corner
_DICTIONARY = re.compile(r"\dX\d_\d+")
_MOST_VIEWS = 40
FEWEST_VIEWS = 8
_MOST_SEARCHED = 300  # images of a video
_BLURRED = 0.3  # of the median sharpness


@dataclass(frozen=True)
class Board:
    """A board by the corners between its squares.

    Attributes:
        columns, rows: corners along each side; 9 x 6 corners are 10 x 7 squares.
        square_m: side of a square.
        pattern: plain, or with ArUco markers in its white squares.
        dictionary: of the markers, as ``5X5_100``.
        marker_share: side of a marker over that of a square.
    """

    columns: int
    rows: int
    square_m: float = 0.03
    pattern: Pattern = "chessboard"
    dictionary: str = "5X5_100"
    marker_share: float = 0.75

    @property
    def corners_m(self) -> FloatArray:
        """The corners ``(rows * columns, 3)`` row by row, metres, z = 0."""
        row, column = np.mgrid[: self.rows, : self.columns]
        return self.square_m * np.stack([column.ravel(), row.ravel(), np.zeros(row.size)], axis=1)

    def charuco(self) -> Any:
        """OpenCV's ChArUco board.

        Raises:
            SlamError: the dictionary is none of OpenCV's, or has too few markers.
        """
        number = getattr(cv2.aruco, f"DICT_{self.dictionary}", None)
        if number is None or not _DICTIONARY.fullmatch(self.dictionary):
            raise SlamError(
                f"--dictionary {self.dictionary} is none of OpenCV's: write it as 5X5_100 or 4X4_50"
            )
        squares = (self.columns + 1, self.rows + 1)
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        if squares[0] * squares[1] // 2 > len(dictionary.bytesList):
            raise SlamError(
                f"dictionary {self.dictionary} has too few markers for {squares[0]}x{squares[1]} squares"
            )
        return cv2.aruco.CharucoBoard(
            squares, self.square_m, self.marker_share * self.square_m, dictionary
        )

    def describe(self) -> str:
        """As ``9x6 chessboard``."""
        return f"{self.columns}x{self.rows} {self.pattern}"


def found_corners(grey: Grey, board: Board, detector: Any) -> tuple[FloatArray, FloatArray] | None:
    """Corners ``(N, 2)`` in pixels and on the board ``(N, 3)`` in metres; None where the board is not found.

    A chessboard is found only as a whole; of a ChArUco board, by its ``detector``, 12 corners will do, not all in one
    line.

    Args:
        grey: the image ``(H, W)`` uint8.
        board: that is sought.
        detector: of a ChArUco board; None for a chessboard.
    """
    corners_m = board.corners_m
    if detector is None:
        size, normalised = (board.columns, board.rows), cv2.CALIB_CB_NORMALIZE_IMAGE
        is_found, pixels = cv2.findChessboardCornersSB(grey, size, flags=normalised)
        return (_refined(grey, pixels, _WINDOW), corners_m) if is_found else None
    pixels, numbers, *_ = detector.detectBoard(grey)
    if numbers is None or len(numbers) < _LEAST_CHARUCO:
        return None
    corners_m = corners_m[np.asarray(numbers).ravel()]
    if np.linalg.matrix_rank(corners_m - corners_m.mean(axis=0)) < 2:
        return None
    beside_marker = (1 - board.marker_share) / 2
    return _refined(grey, pixels, min(_WINDOW, beside_marker)), corners_m


def _refined(grey: Grey, pixels: Any, window: float) -> FloatArray:
    """Corners ``(N, 2)`` where the gradients around them meet: three times closer than the search finds them."""
    corners = np.ascontiguousarray(pixels, np.float32).reshape(-1, 1, 2)
    nearest = float(pdist(corners[:, 0]).min())
    half = int(np.clip(window * nearest, 2, _MOST_HALF_WINDOW_PX))
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-3)
    refined = cv2.cornerSubPix(grey, corners, (half, half), (-1, -1), stop)
    return np.asarray(refined, np.float64).reshape(-1, 2)


def parse_board(text: str) -> tuple[int, int]:
    """Columns and rows of corners from ``9x6``.

    Raises:
        SlamError: it is not such a text, or has fewer than 3 corners a side.
    """
    match = _BOARD.fullmatch(text)
    columns, rows = (int(match[1]), int(match[2])) if match else (0, 0)
    if min(columns, rows) < _FEWEST:
        raise SlamError(
            f"--board {text} is no board: write the corners between its squares, 9x6 for 10 by 7 squares, 3 or more"
        )
    return columns, rows


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
        SlamError: too few images show the board.
        DataError, SequenceError: an image cannot be read.
    """
    detector = cv2.aruco.CharucoDetector(board.charuco()) if board.pattern == "charuco" else None
    step = -(-len(images) // _MOST_SEARCHED)
    frames = range(0, len(images), step)
    views = []
    for count, frame in enumerate(frames, start=1):
        grey = np.asarray(cv2.cvtColor(images.read(frame), cv2.COLOR_RGB2GRAY), np.uint8)
        found = found_corners(grey, board, detector)
        if found is not None:
            views.append(_view(frame, grey, *found))
        progress("images", count, len(frames))
    if len(views) < FEWEST_VIEWS:
        raise SlamError(
            f"{len(views)} of {len(frames)} images show the whole {board.describe()}, {FEWEST_VIEWS} are needed: take "
            "20 or more sharp images with all of the board in them, at many places and tilts; --board counts the "
            "corners between its squares"
        )
    return views


def chosen_views(views: list[View]) -> list[View]:
    """At most 40 views that differ most from each other, sharp ones first, in the order of time.

    The next is always the one whose place is furthest from those of all before, times its sharpness' rank.
    """
    median = float(np.median([view.sharpness for view in views]))
    sharp = [view for view in views if view.sharpness >= _BLURRED * median]
    if len(sharp) <= _MOST_VIEWS:
        return sharp
    ranks = np.argsort(np.argsort([view.sharpness for view in sharp])) / (len(sharp) - 1)
    places = np.array([view.place for view in sharp])
    taken = [int(np.argmax(ranks))]
    distances = np.full(len(sharp), np.inf)
    while len(taken) < _MOST_VIEWS:
        distances = np.minimum(distances, np.linalg.norm(places - places[taken[-1]], axis=1))
        taken.append(int(np.argmax(distances * (1 + ranks))))
    return [sharp[k] for k in sorted(set(taken))]


def _view(frame: int, grey: Grey, pixels: FloatArray, corners_m: FloatArray) -> View:
    height, width = grey.shape
    hull = cv2.convexHull(pixels.astype(np.float32))
    mask = cv2.fillConvexPoly(np.zeros_like(grey), np.rint(hull).astype(np.int32), 255) > 0
    sharpness = float(
        cv2.Laplacian(grey, cv2.CV_64F)[mask].var() / max(float(grey[mask].var()), 1.0)
    )
    extent = np.ptp(corners_m[:, :2], axis=0)
    plane = (corners_m[:, :2] - corners_m[:, :2].mean(axis=0)) / extent
    homography, _ = cv2.findHomography(plane, pixels / width)
    tilt = np.zeros(2) if homography is None else homography[2, :2] / homography[2, 2]
    middle = pixels.mean(axis=0) / [width, height]
    size = np.sqrt(cv2.contourArea(hull) / (width * height))
    return View(frame, pixels, corners_m, sharpness, np.array([*middle, size, *tilt]))
