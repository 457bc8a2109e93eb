"""Undistortion of images to a pinhole camera, as they are read."""

from __future__ import annotations

import logging
from dataclasses import replace

import cv2
import numpy as np

from erfsfm.common.readers.camera_file import CameraFile
from slam.frames import DepthMap, Image, Intrinsics, sampled_depth
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError
from slam.sequences.images import Sized

logger = logging.getLogger(__name__)

_ZOOM_STEP = 1.02
_ZOOM_LIMITS = (0.2, 8.0)
_UNLIKELY_ZOOM, _FOLDED_ZOOM = 1.5, 3.0
_CHECK = "check the coefficients and the model in the camera file"


class Undistortion:
    """The pinhole camera of a distorted one: same image size, no black borders.

    The new camera keeps the principal point and the ratio fx : fy; its focal length is the shortest one
    whose whole image lies inside the distorted image (OpenCV's ``alpha = 0``, but exact at the border
    and the same for both lens models).
    """

    def __init__(self, camera: CameraFile) -> None:
        self._K = Intrinsics.of(camera.pinhole).K
        self._coefficients = np.asarray(camera.distortion, dtype=np.float64)
        self._model = camera.model
        zoom = self._shortest_zoom(camera.width, camera.height)
        if zoom > _FOLDED_ZOOM:
            raise SequenceError(f"distortion {list(camera.distortion)} folds the image: {_CHECK}")
        if zoom > _UNLIKELY_ZOOM:
            text = "distortion %s leaves only the middle %.0f %% of the image's width: %s"
            logger.warning(text, list(camera.distortion), 100 / zoom, _CHECK)
        focal = zoom * camera.fx, zoom * camera.fy
        readout_s = camera.readout_ms / 1e3
        self.intrinsics = Intrinsics(
            camera.width, camera.height, *focal, camera.cx, camera.cy, undistorted=True, readout_s=readout_s
        )
        pixels = self.intrinsics.pixel_grid()
        seen = self.distort(pixels.reshape(-1, 2), self.intrinsics.K).astype(np.float32).reshape(pixels.shape)
        self._maps = np.ascontiguousarray(seen[..., 0]), np.ascontiguousarray(seen[..., 1])

    def apply(self, image: Image) -> Image:
        """Undistort an image ``(H, W, 3)``."""
        camera, (height, width) = self.intrinsics, image.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise SequenceError(
                f"the image is {width}x{height}, its camera {camera.width}x{camera.height}: "
                "give the calibration of this camera at this size"
            )
        flat: Image = cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return flat

    def apply_to_depth(self, depth: DepthMap) -> DepthMap:
        """Undistort z-depth ``(H, W)`` of an image, not positive or not finite where unknown."""
        return sampled_depth(depth, *self._maps)

    def distort(self, pixels: FloatArray, K: FloatArray) -> FloatArray:
        """Distorted pixels of the ``pixels`` ``(N, 2)`` of a pinhole ``K`` ``(3, 3)``."""
        rays = (pixels - K[:2, 2]) / K[[0, 1], [0, 1]]
        if self._model == "fov":
            distorted = self._bend(rays) * self._K[[0, 1], [0, 1]] + self._K[:2, 2]
        elif self._model == "fisheye":
            distorted = cv2.fisheye.distortPoints(rays[:, None], self._K, self._coefficients)
        else:
            points = np.column_stack([rays, np.ones(len(rays))])
            distorted, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self._K, self._coefficients)
        seen: FloatArray = np.asarray(distorted, dtype=np.float64).reshape(-1, 2)
        return seen

    def _bend(self, rays: FloatArray) -> FloatArray:
        """The FOV lens (Devernay and Faugeras 2001): radii in the image grow with the angle of a ray."""
        (angle,) = self._coefficients
        radius = np.linalg.norm(rays, axis=1, keepdims=True)
        bent = np.arctan(2 * radius * np.tan(angle / 2)) / angle
        return np.asarray(rays * bent / np.maximum(radius, 1e-12))

    def _shortest_zoom(self, width: int, height: int) -> float:
        """Zoom out from the centre until the border of the pinhole image meets that of the lens's image."""
        corner = np.array([width - 1.0, height - 1.0])
        v, u = np.mgrid[:height, :width].reshape(2, -1).astype(np.float64)
        at_edge = (u == 0) | (u == width - 1) | (v == 0) | (v == height - 1)
        border = np.column_stack([u, v])[at_edge]
        zoom, radius = _ZOOM_LIMITS[1], np.zeros(len(border))
        fits = False
        while zoom > _ZOOM_LIMITS[0]:
            K = self._K.copy()
            K[[0, 1], [0, 1]] *= zoom
            seen = self.distort(border, K)
            further = np.linalg.norm(seen - K[:2, 2], axis=1)
            if (further < radius).any() or not ((seen >= 0) & (seen <= corner)).all():
                break
            zoom, radius, fits = zoom / _ZOOM_STEP, further, True
        if not fits:
            raise SequenceError(
                f"distortion {self._coefficients.tolist()} leaves no image free of black borders: {_CHECK}"
            )
        return zoom * _ZOOM_STEP


def require_size(images: Sized, camera: CameraFile, where: str) -> None:
    """Refuse images of another size than their camera."""
    if (images.width, images.height) == (camera.width, camera.height):
        return
    if (images.width, images.height) == (camera.height, camera.width):
        wanted = "they are turned by a quarter, perhaps by their own metadata: turn them back"
    else:
        scaled = camera.pinhole.resized(images.width, images.height)
        values = ", ".join(f"{name}: {getattr(scaled, name):.6g}" for name in ("fx", "fy", "cx", "cy"))
        keys = f"width: {images.width}, height: {images.height}, {values}"
        wanted = f"resize the images, or if they were only resized, scale the file to {{{keys}}}"
    raise SequenceError(
        f"the images of {where} are {images.width}x{images.height}, but the camera file is for "
        f"{camera.width}x{camera.height}: {wanted}"
    )


def undistorted(camera: CameraFile) -> tuple[Intrinsics, Undistortion | None]:
    """The camera of images after their distortion is taken out, and what takes it out; None where there is none."""
    if camera.is_distorted:
        undistortion = Undistortion(camera)
        return undistortion.intrinsics, undistortion
    return replace(Intrinsics.of(camera.pinhole), readout_s=camera.readout_ms / 1e3), None
