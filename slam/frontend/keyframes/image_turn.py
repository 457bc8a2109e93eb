"""How the camera turned since the last image, by aligning small images: bare walls and windows show it without corners.

Small images as PTAM aligns them (Klein and Murray 2008), over the three angles of a turn, with the
gradients of the first image (Baker and Matthews 2004). Rows of a rolling shutter are read one after
another while the camera turns: corners are moved to where one moment would show them, by a turn at
a steady rate that moves the image as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam.frames import Grey, Intrinsics, slopes_of
from slam.frontend.tracking import Pixels
from slam.geometry.multiview import rotation_between
from slam.geometry.se3 import FloatArray, compose, rotation_matrix

_REDUCED = 8  # an image over the small one
_COARSE = 2  # a small image over the one that all guesses are tried on
_SMOOTH_PX = 4.0  # of small images, around which contrast is local
_LEAST_CONTRAST = 3.0  # grey levels, of noise
_OUTLIER = 0.7  # residual of local contrast at which a pixel counts half
_ITERATIONS, _CONVERGED = 10, 1e-4
_LEAST_PIXELS = 200
_CLEAR = 0.8  # correlation of turned images from which on no other guess is tried
_LEAST_CORNERS, _SHUTTER_ITERATIONS = 20, 3  # by which a rolling shutter's turn is measured

SmallImage = NDArray[np.float32]
_Places = TypeVar("_Places", Pixels, FloatArray)


@dataclass(frozen=True)
class ImageTurn:
    """``R_now_before`` and the correlation of the two images turned so, 0 where they share too little."""

    R_now_before: FloatArray
    correlation: float = 0.0


def small_image(grey: Grey) -> SmallImage:
    """An image at an eighth of its size."""
    size = max(grey.shape[1] // _REDUCED, 1), max(grey.shape[0] // _REDUCED, 1)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.float32)


def image_shift(before: SmallImage, now: SmallImage) -> FloatArray:
    """By how many pixels ``(2,)`` the whole image moved, by phase correlation (Kuglin and Hines 1975)."""
    if before.shape != now.shape:
        return np.zeros(2)
    window = cv2.createHanningWindow(now.shape[::-1], cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(before.copy(), now.copy(), window)  # which writes into them
    return _REDUCED * np.asarray(shift)


def image_turn(
    before: SmallImage,
    now: SmallImage,
    R_guess: FloatArray,
    shift: FloatArray,
    intrinsics: Intrinsics,
) -> ImageTurn:
    """The turn from a guess, from the shift of the whole image or from none, whichever fits best.

    Args:
        before: the last image.
        now: this image; of another size, it is not turned.
        R_guess: a guess of the turn ``(3, 3)``, as ``R_now_before``.
        shift: of the whole image ``(2,)``, pixels of the full image.
        intrinsics: of the full image.
    """
    if before.shape != now.shape:
        return ImageTurn(np.eye(3))
    scale = 1.0 / _REDUCED
    pairs = [(before, now, scale)]
    if min(now.shape) >= 2 * _COARSE * _SMOOTH_PX:
        size = now.shape[1] // _COARSE, now.shape[0] // _COARSE
        coarse = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (before, now))
        pairs.insert(0, (*coarse, scale / _COARSE))
    yaw, pitch = np.arctan(shift / [intrinsics.fx, intrinsics.fy])
    R_shift = rotation_matrix(np.array([-pitch, yaw, 0.0]))
    turns = [ImageTurn(guess) for guess in (R_guess, R_shift, np.eye(3))]
    for first, second, size_ratio in pairs:
        problem = _Alignment(first, second, intrinsics, size_ratio)
        solved: list[ImageTurn] = []
        for turn in turns:
            solved.append(problem.solve(turn.R_now_before))
            if solved[-1].correlation > _CLEAR:
                break
        turns = [max(solved, key=lambda turn: turn.correlation)]
    return turns[0]


class _Alignment:
    """Two images of local contrast, one of which is turned until they are alike."""

    def __init__(
        self, before: SmallImage, now: SmallImage, intrinsics: Intrinsics, scale: float
    ) -> None:
        sigma = _SMOOTH_PX * scale * _REDUCED
        first, self._now = _local_contrast(before, sigma), _local_contrast(now, sigma)
        self._focal = np.array([intrinsics.fx * scale, intrinsics.fy * scale], np.float32)
        self._centre = np.array(
            [(intrinsics.cx + 0.5) * scale - 0.5, (intrinsics.cy + 0.5) * scale - 0.5], np.float32
        )
        height, width = first.shape
        y, x = np.mgrid[:height, :width].reshape(2, -1)
        u, v = (x - self._centre[0]) / self._focal[0], (y - self._centre[1]) / self._focal[1]
        self._rays = np.stack([u, v, np.ones_like(u)]).astype(np.float32)
        self._first = first.ravel()
        by_u, by_v = (
            focal * slope.ravel()
            for focal, slope in zip(self._focal, slopes_of(first), strict=True)
        )
        # of the first image, by a small turn of its rays
        self._jacobian = np.stack(
            [
                -by_u * u * v - by_v * (1 + v * v),
                by_u * (1 + u * u) + by_v * u * v,
                by_v * u - by_u * v,
            ]
        ).astype(np.float32)

    def solve(self, R: FloatArray) -> ImageTurn:
        """From one guess."""
        for _ in range(_ITERATIONS):
            turned, inside = self._turned(R)
            if np.count_nonzero(inside) < _LEAST_PIXELS:
                return ImageTurn(R)
            residual = turned - self._first
            weighted = self._jacobian * (inside / (1.0 + (residual / _OUTLIER) ** 2))
            information = (weighted @ self._jacobian.T).astype(np.float64) + 1e-6 * np.eye(3)
            step = np.asarray(np.linalg.solve(information, weighted @ residual), np.float64)
            R = compose(R, rotation_matrix(-step))
            if np.abs(step).max() < _CONVERGED:
                break
        turned, inside = self._turned(R)
        if np.count_nonzero(inside) < _LEAST_PIXELS:
            return ImageTurn(R)
        return ImageTurn(R, float(np.corrcoef(turned[inside], self._first[inside])[0, 1]))

    def _turned(self, R: FloatArray) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """The second image at the pixels of the first one ``(N,)``, and where it shows them."""
        x, y, z = R.astype(np.float32) @ self._rays
        ahead = z > 0.1
        z = np.where(ahead, z, np.float32(1.0))
        u, v = x / z * self._focal[0] + self._centre[0], y / z * self._focal[1] + self._centre[1]
        height, width = self._now.shape
        inside = ahead & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
        return cv2.remap(self._now, u[None], v[None], cv2.INTER_LINEAR)[0], inside


def _local_contrast(image: SmallImage, sigma: float) -> SmallImage:
    """Without its local mean and over its local contrast, so that neither light nor shadow is motion."""
    high = image - cv2.GaussianBlur(image, (0, 0), sigma)
    return high / np.sqrt(cv2.GaussianBlur(high * high, (0, 0), sigma) + _LEAST_CONTRAST**2)


def turned(pixels: Pixels | FloatArray, R_now_before: FloatArray, intrinsics: Intrinsics) -> Pixels:
    """Where pixels ``(M, 2)`` of the last image are after a turn; those behind the camera stay."""
    rays = intrinsics.rays(pixels.astype(np.float64)) @ R_now_before.T
    ahead = rays[:, 2:] > 0.1
    return np.where(ahead, intrinsics.project(rays), pixels).astype(np.float32)


def in_middle_row(pixels: _Places, turn: FloatArray, intrinsics: Intrinsics) -> _Places:
    """Pixels ``(M, 2)`` of an image as the camera sees them when the middle row is read.

    The camera's ``turn`` ``(3,)`` is a rotation vector a second, as of ``R_current_previous``.
    """
    if not intrinsics.readout_s or not len(pixels):
        return pixels
    seconds = intrinsics.readout_s * ((pixels[:, 1] + 0.5) / intrinsics.height - 0.5)
    rays = Rotation.from_rotvec(-seconds[:, None] * turn).apply(
        intrinsics.rays(pixels.astype(np.float64))
    )
    return intrinsics.project(rays).astype(pixels.dtype)


def measured_turn(
    before: Pixels | FloatArray,
    pixels: Pixels,
    seconds: float,
    turn: FloatArray,
    intrinsics: Intrinsics,
) -> FloatArray:
    """The turn a second ``(3,)`` between two images; zero with few corners.

    Args:
        before: corners when the middle row of the last image was read ``(M, 2)``.
        pixels: where this image has them ``(M, 2)``.
        seconds: between the images.
        turn: a second, of the time before, from which it is started.
        intrinsics: of the images, with the time that reading one takes.
    """
    if len(pixels) < _LEAST_CORNERS or seconds <= 0:
        return np.zeros(3)
    rays_before = intrinsics.rays(before.astype(np.float64))
    for _ in range(_SHUTTER_ITERATIONS):
        rays = intrinsics.rays(in_middle_row(pixels, turn, intrinsics).astype(np.float64))
        turn = Rotation.from_matrix(rotation_between(rays_before, rays)).as_rotvec() / seconds
    return turn
