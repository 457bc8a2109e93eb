"""The fit of a camera and its lens to views of a board, and what makes it no calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SlamError
from slam.sequences.board import FEWEST_VIEWS, View

Model = Literal["opencv", "fisheye"]

_FLAGS_HOME = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye  # before OpenCV 5
_FISHEYE_FLAGS = _FLAGS_HOME.CALIB_RECOMPUTE_EXTRINSIC | _FLAGS_HOME.CALIB_FIX_SKEW
_OUTLIER = 3.0  # times the median error of a view
_GAIN = 0.98  # of the error, below which the sixth power of the radius is worth a coefficient
_MOST_ERROR_PX = 1.0  # for images 640 pixels wide
_MOST_FOCAL_SIGMA = 0.005  # of the focal length
_LEAST_TILT_DEG = 10.0
_LEAST_COVERED = 0.3  # of the image


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
        focal_sigma: standard deviation of the focal length over itself, for errors that are independent.
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
        return np.asarray(
            np.rad2deg(np.arccos(np.clip(np.abs(self.T_camera_board[:, 2, 2]), 0, 1)))
        )

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
        fit = _fit(
            [view for view, is_good in zip(views, good, strict=True) if is_good],
            width,
            height,
            model,
        )
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
        if model == "fisheye":
            return _fit_lens(views, width, height, model, _FISHEYE_FLAGS)
        plain = _fit_lens(views, width, height, model, cv2.CALIB_FIX_K3)
        bent = _fit_lens(views, width, height, model, 0)
    except cv2.error as error:
        reason = " ".join(str(error.err or error).split())
        raise SlamError(
            f"OpenCV finds no {model} camera for these views ({reason}): show the board at more places and tilts"
        ) from error
    return bent if bent.error_px < _GAIN * plain.error_px else plain


def _fit_lens(views: list[View], width: int, height: int, model: Model, flags: int) -> Calibration:
    """A camera, its residuals, and how sure its focal length is by the normal equations with the poses eliminated."""
    is_fisheye = model == "fisheye"
    calibrate: Any = cv2.fisheye.calibrate if is_fisheye else cv2.calibrateCamera
    project: Any = cv2.fisheye.projectPoints if is_fisheye else cv2.projectPoints
    precision = np.float64 if is_fisheye else np.float32
    corners = [view.corners_m[None].astype(precision) for view in views]
    pixels = [view.pixels[None].astype(precision) for view in views]
    start = (np.zeros((3, 3)), np.zeros((4, 1))) if is_fisheye else (None, None)
    _, K, distortion, turns, places = calibrate(
        corners, pixels, (width, height), *start, flags=flags
    )
    distortion = distortion.ravel()[:5]
    count = 4 + len(distortion)
    # where the columns of the camera and of the pose are in OpenCV's derivatives
    of_camera, of_pose = (
        (slice(count), slice(count, count + 6)) if is_fisheye else (slice(6, 6 + count), slice(6))
    )
    residuals, information = [], np.zeros((count, count))
    T_camera_board = np.tile(np.eye(4), (len(views), 1, 1))
    for T, view, turn, place in zip(T_camera_board, views, turns, places, strict=True):
        T[:3, :3], T[:3, 3] = Rotation.from_rotvec(np.ravel(turn)).as_matrix(), np.ravel(place)
        projected, J = project(view.corners_m[:, None], turn, place, K, distortion)
        residuals.append(view.pixels - np.asarray(projected, np.float64).reshape(-1, 2))
        by_pose = J[:, of_pose] @ np.linalg.lstsq(J[:, of_pose], J[:, of_camera], rcond=None)[0]
        information += J[:, of_camera].T @ (J[:, of_camera] - by_pose)
    freedom = sum(residual.size for residual in residuals) - count - 6 * len(views)
    variance = sum(float((residual**2).sum()) for residual in residuals) / max(freedom, 1)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True) / np.outer(
        scale, scale
    )
    sigma = float(np.sqrt(max(variance * inverse[:2, :2].mean(), 0.0))) / (
        0.5 * (K[0, 0] + K[1, 1])
    )
    return Calibration(
        model, width, height, np.asarray(K), distortion, views, residuals, T_camera_board, sigma
    )
