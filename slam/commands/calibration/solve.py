"""The camera that explains all views of a board, and whether they determine it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from slam.commands.calibration.views import FEWEST_VIEWS, View
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import CalibrationError

Model = Literal["opencv", "fisheye"]

_FLAGS_HOME = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye  # before OpenCV 5
_FISHEYE_FLAGS = _FLAGS_HOME.CALIB_RECOMPUTE_EXTRINSIC | _FLAGS_HOME.CALIB_FIX_SKEW

_OUTLIER = 3.0  # times the median error of a view
_GAIN = 0.98  # of the error, below which the sixth power of the radius is worth a coefficient
_MOST_ERROR_PX = 1.0  # for images 640 pixels wide
_MOST_FOCAL_SIGMA = 0.005  # of the focal length
_LEAST_TILT_DEG = 10.0
_LEAST_COVERED = 0.3  # of the image
WELL_COVERED = 0.6


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
        return np.asarray(np.rad2deg(np.arccos(np.clip(np.abs(self.T_camera_board[:, 2, 2]), 0, 1))))

    @property
    def covered(self) -> float:
        """Share of the image inside the convex hull of all corners."""
        hull = cv2.convexHull(np.concatenate([view.pixels for view in self.views]).astype(np.float32))
        return float(cv2.contourArea(hull)) / (self.width * self.height)


def calibrate(views: list[View], width: int, height: int, model: Model) -> Calibration:
    """Fit a camera to views of a board; views that fit three times worse than the median are left out.

    Raises:
        CalibrationError: the views do not determine the camera, or no camera explains them.
    """
    found = _fit(views, width, height, model)
    good = found.errors_px <= _OUTLIER * np.median(found.errors_px)
    if not good.all():
        found = _fit([view for view, is_good in zip(views, good, strict=True) if is_good], width, height, model)
    _require_determined(found)
    return found


def _fit(views: list[View], width: int, height: int, model: Model) -> Calibration:
    if len(views) < FEWEST_VIEWS:
        raise CalibrationError(f"{len(views)} sharp views fit one camera, {FEWEST_VIEWS} are needed: take more images")
    try:
        if model == "fisheye":
            return _fit_fisheye(views, width, height)
        plain = _fit_opencv(views, width, height, cv2.CALIB_FIX_K3)
        bent = _fit_opencv(views, width, height, 0)
    except cv2.error as error:
        reason = " ".join(str(error.err or error).split())
        raise CalibrationError(
            f"OpenCV finds no {model} camera for these views ({reason}): show the board at more places and tilts"
        ) from error
    return bent if bent.error_px < _GAIN * plain.error_px else plain


def _fit_opencv(views: list[View], width: int, height: int, flags: int) -> Calibration:
    corners = [view.corners_m.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    _, K, distortion, turns, places = cv2.calibrateCamera(corners, pixels, (width, height), None, None, flags=flags)
    return _calibration("opencv", views, (width, height), K, distortion.ravel()[:5], _vectors(turns, places))


def _fit_fisheye(views: list[View], width: int, height: int) -> Calibration:
    corners, pixels = [view.corners_m[None] for view in views], [view.pixels[None] for view in views]
    K, distortion = np.zeros((3, 3)), np.zeros((4, 1))
    _, K, distortion, turns, places = cv2.fisheye.calibrate(
        corners, pixels, (width, height), K, distortion, flags=_FISHEYE_FLAGS
    )
    return _calibration("fisheye", views, (width, height), K, distortion.ravel(), _vectors(turns, places))


def _vectors(turns: Any, places: Any) -> FloatArray:
    """Rotation vectors and translations of all views ``(V, 6)``."""
    return np.array([np.concatenate([np.ravel(r), np.ravel(t)]) for r, t in zip(turns, places, strict=True)])


def _calibration(
    model: Model, views: list[View], size: tuple[int, int], K: FloatArray, distortion: FloatArray, poses: FloatArray
) -> Calibration:
    intrinsics = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], distortion])
    residuals = [
        view.pixels - _projected(model, view, intrinsics, pose) for view, pose in zip(views, poses, strict=True)
    ]
    T_camera_board = np.tile(np.eye(4), (len(views), 1, 1))
    T_camera_board[:, :3, :3] = Rotation.from_rotvec(poses[:, :3]).as_matrix()
    T_camera_board[:, :3, 3] = poses[:, 3:]
    sigma = _focal_sigma(model, views, intrinsics, poses, residuals)
    return Calibration(model, *size, np.asarray(K), distortion, views, residuals, T_camera_board, sigma)


def _projected(model: Model, view: View, intrinsics: FloatArray, pose: FloatArray) -> FloatArray:
    """Pixels ``(N, 2)`` of the corners of a view."""
    fx, fy, cx, cy = intrinsics[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if model == "fisheye" else cv2.projectPoints
    pixels, _ = project(view.corners_m[:, None], pose[:3], pose[3:], K, intrinsics[4:])
    return np.asarray(pixels, np.float64).reshape(-1, 2)


def _focal_sigma(
    model: Model, views: list[View], intrinsics: FloatArray, poses: FloatArray, residuals: list[FloatArray]
) -> float:
    """Standard deviation of the mean focal length over itself, by the normal equations with the poses eliminated."""
    count = len(intrinsics)
    information = np.zeros((count, count))
    for view, pose in zip(views, poses, strict=True):
        both = np.concatenate([intrinsics, pose])
        steps = 1e-6 * np.maximum(np.abs(both), 1e-2)
        columns = []
        for k, step in enumerate(steps):
            after, before = both.copy(), both.copy()
            after[k] += step
            before[k] -= step
            moved = _projected(model, view, after[:count], after[count:]) - _projected(
                model, view, before[:count], before[count:]
            )
            columns.append(moved.ravel() / (2 * step))
        J = np.stack(columns, axis=1)
        A, B = J[:, :count], J[:, count:]
        information += A.T @ (A - B @ np.linalg.lstsq(B, A, rcond=None)[0])
    freedom = sum(r.size for r in residuals) - count - poses.size
    variance = sum(float((r**2).sum()) for r in residuals) / max(freedom, 1)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    covariance = (
        np.linalg.pinv(information / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale) * variance
    )
    mean = np.zeros(count)
    mean[:2] = 0.5
    return float(np.sqrt(np.maximum(mean @ covariance @ mean, 0.0)) / (mean @ intrinsics))


def _require_determined(found: Calibration) -> None:
    """Refuse a camera that the views do not determine.

    Raises:
        CalibrationError: with what to do.
    """
    advice = "tilt it by 20 to 45 degrees about both axes, near and far, also at the borders of the image"
    steepest = float(found.tilts_deg.max())
    if steepest < _LEAST_TILT_DEG:
        raise CalibrationError(
            f"all {len(found.views)} views are frontal (tilts under {steepest:.0f} degrees): they do not determine the "
            f"focal length; {advice}"
        )
    limit = _MOST_ERROR_PX * max(found.width / 640, 1.0)
    if found.error_px > limit:
        raise CalibrationError(
            f"the reprojection error is {found.error_px:.2f} pixels, {limit:.1f} at most: is the board flat, --board "
            f"right, and --model {found.model} that of the lens?"
        )
    if not found.focal_sigma <= _MOST_FOCAL_SIGMA:
        raise CalibrationError(
            f"the views leave the focal length uncertain by {100 * found.focal_sigma:.1f} %, at most "
            f"{100 * _MOST_FOCAL_SIGMA:.1f} %: {advice}"
        )
    if found.covered < _LEAST_COVERED:
        raise CalibrationError(
            f"the board was seen in {100 * found.covered:.0f} % of the image alone, {100 * _LEAST_COVERED:.0f} % at "
            f"least: the lens is not determined elsewhere; {advice}"
        )
