"""Random flip, scale-crop and colour of a whole snippet, with its camera."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.config import DataConfig, Fidelity
from erfsfm.geometry.camera import Camera

Images = list[NDArray[np.uint8]]
Maps = list[NDArray[np.float32]]


def augment(
    images: Images, maps: Maps, camera: Camera, config: DataConfig, fidelity: Fidelity, rng: np.random.Generator
) -> tuple[Images, Maps, Camera, bool]:
    """Flip, scale-crop and recolour a snippet, all frames in the same way.

    Args:
        images: ``(H, W, 3)`` uint8 each.
        maps: ``(H, W)`` each, per-pixel data: moved by nearest neighbour, never recoloured.
        camera: of these images.
        config: probabilities and largest changes.
        fidelity: ``paper`` mirrors and scales the principal point as the reference does.
        rng: of all random draws.

    Returns:
        Images and maps of the same size, their camera, and whether they are mirrored.
    """
    mirrored = bool(rng.random() < config.flip)
    if mirrored:
        images = [np.ascontiguousarray(image[:, ::-1]) for image in images]
        maps = [np.ascontiguousarray(values[:, ::-1]) for values in maps]
        camera = camera.flipped(fidelity)
    if config.zoom > 1:
        images, maps, camera = _scale_crop(images, maps, camera, config.zoom, fidelity, rng)
    if config.colour_jitter > 0:
        images = _recolour(images, config.colour_jitter, rng)
    return images, maps, camera, mirrored


def rolled(
    image: NDArray[np.uint8], maps: Maps, camera: Camera, angle: float, unknown: Sequence[float]
) -> tuple[NDArray[np.uint8], Maps]:
    """The image ``(H, W, 3)`` and maps of the camera turned about its optical axis, which leaves z-depth as it is.

    Args:
        image: of the camera.
        maps: ``(H, W)`` each.
        camera: of them.
        angle: radians.
        unknown: value of each map beyond the image's edges, where the image is mirrored.
    """
    K = camera.K.astype(np.float64)
    cos, sin = np.cos(angle), np.sin(angle)
    move = (K @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ np.linalg.inv(K))[:2]
    size = (camera.width, camera.height)
    turned = cv2.warpAffine(image, move, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    nearest = [
        cv2.warpAffine(values, move, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=value)
        for values, value in zip(maps, unknown, strict=True)
    ]
    return np.asarray(turned, np.uint8), nearest


def _scale_crop(
    images: Images, maps: Maps, camera: Camera, zoom: float, fidelity: Fidelity, rng: np.random.Generator
) -> tuple[Images, Maps, Camera]:
    """Enlarge each axis by its own factor and crop back at a random place."""
    width, height = camera.width, camera.height
    zoom_x, zoom_y = rng.uniform(1, zoom, 2)
    size = int(width * zoom_x), int(height * zoom_y)
    enlarged = camera.resized(*size) if fidelity == "default" else camera.multiplied(zoom_x, zoom_y)
    left = int(rng.integers(size[0] - width + 1))
    top = int(rng.integers(size[1] - height + 1))
    part = slice(top, top + height), slice(left, left + width)
    crops = [np.ascontiguousarray(cv2.resize(i, size, interpolation=cv2.INTER_LINEAR)[part]) for i in images]
    moved = [np.ascontiguousarray(cv2.resize(m, size, interpolation=cv2.INTER_NEAREST_EXACT)[part]) for m in maps]
    return crops, moved, enlarged.cropped(left, top, width, height)


def _recolour(images: Images, strength: float, rng: np.random.Generator) -> Images:
    """Brightness, contrast and gamma by one look-up table per channel; gains of the channels differ little."""
    gain = 1 + rng.uniform(-strength, strength)
    gamma = 1 + rng.uniform(-strength, strength)
    contrast = 1 + rng.uniform(-strength, strength)
    tint = 1 + rng.uniform(-strength, strength, 3) / 3
    grey = rng.random() < 0.3
    values = np.arange(256) / 255
    curve = (np.power(values, gamma) - 0.45) * contrast + 0.45
    table = np.clip(np.rint(curve[:, None] * gain * tint * 255), 0, 255).astype(np.uint8)[None]  # (1, 256, 3)
    if grey:
        images = [cv2.cvtColor(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB) for i in images]
        table = np.repeat(table[..., :1], 3, axis=-1)
    return [cv2.LUT(image, table) for image in images]
