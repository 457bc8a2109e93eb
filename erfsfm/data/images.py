"""Image files: which a folder holds, how large they are, and the one way of resizing them."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.errors import DataError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


def image_files(folder: Path) -> tuple[Path, ...]:
    """The images of a folder in natural order: ``2.png`` before ``10.png``."""
    images = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    return tuple(sorted(images, key=_natural_key))


def image_size(path: Path) -> tuple[int, int]:
    """Height and width of an image file."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise DataError(f"{path} is missing or not a readable image")
    return int(image.shape[0]), int(image.shape[1])


def resize_image(image: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """An image ``(H, W, 3)`` at ``height x width``, without crop: the one way in training and in inference."""
    if image.shape[:2] == (height, width):
        return image
    shrinks = image.shape[0] >= height and image.shape[1] >= width
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=method))


def require_numbered(images: tuple[Path, ...]) -> None:
    """Frames 0, 1, 2, ...: a gap would be a jump to the networks, an offset a false leak record."""
    for index, image in enumerate(images):
        if not image.stem.isdecimal() or int(image.stem) != index:
            wanted = f"{index:0{len(images[0].stem)}d}"
            raise DataError(f"{image.parent} has no frame {wanted}: KITTI numbers from 0; found {image.name} there")


def _natural_key(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]
