"""The board: its corners in its own plane, and where an image shows them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from scipy.spatial.distance import pdist

from slam.frames import Grey
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import CalibrationError

Pattern = Literal["chessboard", "charuco"]

_BOARD = re.compile(r"(\d+)x(\d+)")
_FEWEST = 3  # corners along one side
_PROBE = (4, 3)  # corners of a part of a chessboard
_LEAST_CHARUCO = 12  # corners of a view: more than a homography needs
_WINDOW, _MOST_HALF_WINDOW_PX = 0.2, 11  # of the distance to the next corner
_DICTIONARY = re.compile(r"\dX\d_\d+")


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
            CalibrationError: OpenCV has no such dictionary, or it has too few markers.
        """
        number = getattr(cv2.aruco, f"DICT_{self.dictionary}", None)
        if number is None or not _DICTIONARY.fullmatch(self.dictionary):
            raise CalibrationError(f"--dictionary {self.dictionary} is none of OpenCV's: write it as 5X5_100 or 4X4_50")
        squares = (self.columns + 1, self.rows + 1)
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        if squares[0] * squares[1] // 2 > len(dictionary.bytesList):
            raise CalibrationError(
                f"dictionary {self.dictionary} has too few markers for {squares[0]}x{squares[1]} squares"
            )
        return cv2.aruco.CharucoBoard(squares, self.square_m, self.marker_share * self.square_m, dictionary)

    def describe(self) -> str:
        """As ``9x6 chessboard``."""
        return f"{self.columns}x{self.rows} {self.pattern}"


class Detector:
    """Finds the corners of a board in grey images."""

    def __init__(self, board: Board) -> None:
        """Prepare the search.

        Raises:
            CalibrationError: see `Board.charuco`.
        """
        self._board = board
        beside_marker = (1 - board.marker_share) / 2
        self._window = _WINDOW if board.pattern == "chessboard" else min(_WINDOW, beside_marker)
        self._charuco = cv2.aruco.CharucoDetector(board.charuco()) if board.pattern == "charuco" else None

    def find(self, grey: Grey) -> tuple[FloatArray, FloatArray] | None:
        """Corners ``(N, 2)`` in pixels and on the board ``(N, 3)`` in metres; None where the board is not found.

        A chessboard is found only as a whole; of a ChArUco board 12 corners will do, not all in one line.
        """
        if self._charuco is not None:
            pixels, numbers, *_ = self._charuco.detectBoard(grey)
            if numbers is None or len(numbers) < _LEAST_CHARUCO:
                return None
            corners_m = self._board.corners_m[np.asarray(numbers).ravel()]
            if np.linalg.matrix_rank(corners_m - corners_m.mean(axis=0)) < 2:
                return None
            return self._refined(grey, pixels), corners_m
        size = (self._board.columns, self._board.rows)
        is_found, pixels = cv2.findChessboardCornersSB(grey, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        return (self._refined(grey, pixels), self._board.corners_m) if is_found else None

    def _refined(self, grey: Grey, pixels: Any) -> FloatArray:
        """Corners ``(N, 2)`` where the gradients around them meet: three times closer than the search finds them."""
        corners = np.ascontiguousarray(pixels, np.float32).reshape(-1, 1, 2)
        nearest = float(pdist(corners[:, 0]).min())
        half = int(np.clip(self._window * nearest, 2, _MOST_HALF_WINDOW_PX))
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-3)
        refined = cv2.cornerSubPix(grey, corners, (half, half), (-1, -1), stop)
        return np.asarray(refined, np.float64).reshape(-1, 2)

    def sees_part(self, grey: Grey) -> bool:
        """Whether a chessboard that is not found as a whole is there in part."""
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
        return self._charuco is None and bool(cv2.findChessboardCornersSB(grey, _PROBE, flags=flags)[0])


def parse_board(text: str) -> tuple[int, int]:
    """Columns and rows of corners from ``9x6``.

    Raises:
        CalibrationError: if the text is no such size.
    """
    match = _BOARD.fullmatch(text)
    columns, rows = (int(match[1]), int(match[2])) if match else (0, 0)
    if min(columns, rows) < _FEWEST:
        raise CalibrationError(
            f"--board {text} is no board: write the corners between its squares, 9x6 for 10 by 7 squares, 3 or more"
        )
    return columns, rows
