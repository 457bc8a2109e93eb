"""The calibration of a camera and its lens by images of a board.

Corners are found, sharp views are chosen, and the camera is fitted to them;
what makes a fit no calibration is said.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from functools import partial
from itertools import compress
from typing import Any, Literal

import cv2
import numpy as np
from scipy.spatial.distance import pdist

from erfsfm.common.progress import Progress
from slam.frames import Grey
from slam.geometry import se3
from slam.geometry.robust import median
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SlamError
from slam.sequences.images import ImageSource

Pattern = Literal["chessboard", "charuco"]
Model = Literal["opencv", "fisheye"]

logger = logging.getLogger(__name__)
_BOARD = re.compile(r"(\d+)x(\d+)")
_FEWEST = 3  # corners along one side
_LEAST_CHARUCO = 12  # corners of a view: more than a homography needs
_WINDOW, _MOST_HALF_WINDOW_PX = 0.2, 11  # of the distance to the next corner
_DICTIONARY = re.compile(r"\dX\d_\d+")
_MOST_VIEWS = 40
FEWEST_VIEWS = 8
_MOST_SEARCHED = 300  # images of a video
_BLURRED = 0.3  # of the median sharpness
_FLAGS_HOME = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye  # before OpenCV 5
_FISHEYE_FLAGS = _FLAGS_HOME.CALIB_RECOMPUTE_EXTRINSIC | _FLAGS_HOME.CALIB_FIX_SKEW
_OUTLIER = 3.0  # times the median error of a view
_PARTS = 4  # of the views, without each of which the focal length is found once more
_GAIN = 0.98  # of the error, below which the sixth power of the radius is worth a coefficient
_MOST_ERROR_PX = 1.0  # for images 640 pixels wide
_MOST_FOCAL_SIGMA = 0.005  # of the focal length
_LEAST_TILT_DEG = 10.0
_LEAST_COVERED = 0.3  # of the image


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
        size = board.columns, board.rows
        is_found, pixels = cv2.findChessboardCornersSB(
            grey, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE
        )
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
        sharpness: of the image on the board.
    """

    frame: int
    pixels: FloatArray
    corners_m: FloatArray
    sharpness: float


def find_views(images: ImageSource, board: Board, progress: Progress) -> list[View]:
    """All views of a board, of a long video in every n-th image.

    Raises:
        SlamError: too few images show the board.
        DataError, SequenceError: an image cannot be read.
    """
    detector = cv2.aruco.CharucoDetector(board.charuco()) if board.pattern == "charuco" else None
    frames = range(0, len(images), -(-len(images) // _MOST_SEARCHED))
    views = []
    for count, frame in enumerate(frames, start=1):
        grey = np.asarray(cv2.cvtColor(images.read(frame), cv2.COLOR_RGB2GRAY), np.uint8)
        found = found_corners(grey, board, detector)
        if found:
            views.append(View(frame, *found, _sharpness(grey, found[0])))
        elif count == FEWEST_VIEWS and not views:
            text = "none of %d images shows the whole %s so far: --board counts the corners between its squares"
            logger.warning(text, count, board.describe())
        progress("images", count, len(frames))
    if len(views) < FEWEST_VIEWS:
        raise SlamError(
            f"{len(views)} of {len(frames)} images show the whole {board.describe()}, {FEWEST_VIEWS} are needed: take "
            "20 or more sharp images with all of the board in them, at many places and tilts; --board counts the "
            "corners between its squares"
        )
    return views


def chosen_views(views: list[View]) -> list[View]:
    """The sharpest view of each of 40 stretches of the recording, blurred ones left out."""
    usual = median([view.sharpness for view in views])
    sharp = [view for view in views if view.sharpness >= _BLURRED * usual]
    stretches = np.array_split(np.arange(len(sharp)), min(_MOST_VIEWS, len(sharp)))
    return [max((sharp[k] for k in each), key=lambda view: view.sharpness) for each in stretches]


def _sharpness(grey: Grey, pixels: FloatArray) -> float:
    """Variance of the Laplacian on the board over the variance of its grey levels."""
    hull = cv2.convexHull(pixels.astype(np.float32))
    mask = cv2.fillConvexPoly(np.zeros_like(grey), np.rint(hull).astype(np.int32), 255) > 0
    edges = cv2.Laplacian(grey, cv2.CV_64F)[mask]
    return float(edges.var() / max(float(grey[mask].var()), 1.0))


@dataclass(frozen=True, eq=False)
class Calibration:
    """A camera and how well it fits.

    Attributes:
        model: of the lens.
        width, height: of the images, pixels.
        K: the camera matrix ``(3, 3)``.
        distortion: k1 k2 p1 p2 k3, or k1 k2 k3 k4 of a fisheye.
        views: those used.
        residuals: for each of them, corners found less corners projected ``(N, 2)``, pixels.
        T_camera_board: poses of the board ``(V, 4, 4)``.
        focal_sigma: standard deviation of the focal length over itself.
    """

    model: Model
    width: int
    height: int
    K: FloatArray
    distortion: FloatArray
    views: list[View]
    residuals: list[FloatArray]
    T_camera_board: FloatArray
    focal_sigma: float

    @property
    def error_px(self) -> float:
        """Root mean square of the distances between corners found and projected."""
        return float(np.sqrt(np.mean(np.concatenate([(r**2).sum(axis=1) for r in self.residuals]))))

    @property
    def errors_px(self) -> FloatArray:
        """The same of each view ``(V,)``."""
        return np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in self.residuals])

    @property
    def tilts_deg(self) -> FloatArray:
        """Angle between the board and the image plane in each view ``(V,)``."""
        return np.rad2deg(np.arccos(np.clip(np.abs(self.T_camera_board[:, 2, 2]), 0, 1)))

    @property
    def covered(self) -> float:
        """Share of the image inside the convex hull of all corners."""
        hull = cv2.convexHull(
            np.concatenate([view.pixels for view in self.views]).astype(np.float32)
        )
        return float(cv2.contourArea(hull)) / (self.width * self.height)


def fit_camera(views: list[View], width: int, height: int, model: Model) -> Calibration:
    """Fit a camera to views of a board; views that fit three times worse than the median are left out.

    Args:
        views: of one board.
        width: of the images, pixels.
        height: of the images, pixels.
        model: of the lens.

    Raises:
        SlamError: the views do not determine the camera, or no camera explains them.
    """
    fit = _fit(views, width, height, model)
    good = fit.errors_px <= _OUTLIER * np.median(fit.errors_px)
    if not good.all():
        fit = _fit(list(compress(views, good)), width, height, model)
    advice = "tilt it by 20 to 45 degrees about both axes, near and far, also at the borders of the image"
    steepest, most_error = float(fit.tilts_deg.max()), _MOST_ERROR_PX * max(fit.width / 640, 1.0)
    faults = {
        f"all {len(fit.views)} views are frontal (tilts under {steepest:.0f} degrees): they do not determine the focal "
        f"length; {advice}": steepest < _LEAST_TILT_DEG,
        f"the reprojection error is {fit.error_px:.2f} pixels, {most_error:.1f} at most: is the board flat, --board "
        f"right, and --model {fit.model} that of the lens?": fit.error_px > most_error,
        f"the views leave the focal length uncertain by {100 * fit.focal_sigma:.1f} %, at most "
        f"{100 * _MOST_FOCAL_SIGMA:.1f} %: {advice}": not fit.focal_sigma <= _MOST_FOCAL_SIGMA,
        f"the board was seen in {100 * fit.covered:.0f} % of the image alone, {100 * _LEAST_COVERED:.0f} % at least: "
        f"the lens is not determined elsewhere; {advice}": fit.covered < _LEAST_COVERED,
    }
    for words, is_fault in faults.items():
        if is_fault:
            raise SlamError(words)
    return fit


def _fit(views: list[View], width: int, height: int, model: Model) -> Calibration:
    if len(views) < FEWEST_VIEWS:
        raise SlamError(
            f"{len(views)} sharp views fit one camera, {FEWEST_VIEWS} are needed: take more images"
        )
    try:
        fitted = partial(_fit_lens, views, width, height, model)
        if model == "fisheye":
            return fitted(_FISHEYE_FLAGS)
        plain, bent = fitted(cv2.CALIB_FIX_K3), fitted(0)
    except cv2.error as error:
        reason = " ".join(str(error.err or error).split())
        raise SlamError(
            f"OpenCV finds no {model} camera for these views ({reason}): show the board at more places and tilts"
        ) from error
    return bent if bent.error_px < _GAIN * plain.error_px else plain


def _fit_lens(views: list[View], width: int, height: int, model: Model, flags: int) -> Calibration:
    """A camera, its residuals, and how sure its focal length is: a jackknife over parts of the views."""
    is_fisheye = model == "fisheye"
    calibrate: Any = cv2.fisheye.calibrate if is_fisheye else cv2.calibrateCamera
    project: Any = cv2.fisheye.projectPoints if is_fisheye else cv2.projectPoints
    precision = np.float64 if is_fisheye else np.float32
    start = (np.zeros((3, 3)), np.zeros((4, 1))) if is_fisheye else (None, None)

    def solved(used: list[View]) -> Any:
        corners = [view.corners_m[None].astype(precision) for view in used]
        pixels = [view.pixels[None].astype(precision) for view in used]
        _, *found = calibrate(corners, pixels, (width, height), *start, flags=flags)
        return found

    K, distortion, turns, places = solved(views)
    T_camera_board = se3.from_rotation_vector(
        np.reshape(turns, (-1, 3)), np.reshape(places, (-1, 3))
    )
    residuals = []
    for view, turn, place in zip(views, turns, places, strict=True):
        projected, _ = project(view.corners_m[:, None], turn, place, K, distortion)
        residuals.append(view.pixels - np.asarray(projected, np.float64).reshape(-1, 2))
    focal = []
    for part in range(_PARTS):
        others = [view for number, view in enumerate(views) if number % _PARTS != part]
        focal.append(solved(others)[0][[0, 1], [0, 1]].mean())
    sigma = float(np.sqrt(_PARTS - 1) * np.std(focal) / np.mean(focal))
    lens = distortion.ravel()[:5]
    return Calibration(
        model, width, height, np.asarray(K), lens, views, residuals, T_camera_board, sigma
    )
