"""Image files of one size: listed in natural order, checked for gaps, read as RGB."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import cv2
import numpy as np

from slam.errors import SequenceError
from slam.frames import Image

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")
_JPEG_SCAN, _JPEG_END = b"\xff\xda", b"\xff\xd9"
_PNG_START, _PNG_END = b"\x89PNG", b"IEND"


class ImageFiles:
    """Images on disk, all of the size of the first."""

    def __init__(self, paths: list[Path]) -> None:
        """Take at least one path; the first image is read for its size.

        Raises:
            SequenceError: if the first image cannot be read.
        """
        self.paths = paths
        self.height, self.width = read_image(paths[0]).shape[:2]

    def __len__(self) -> int:
        """Number of images."""
        return len(self.paths)

    def read(self, index: int) -> Image:
        """One image ``(height, width, 3)`` uint8 RGB.

        Raises:
            SequenceError: if the file cannot be read or the image has another size than the first.
        """
        image = read_image(self.paths[index])
        height, width = image.shape[:2]
        if (height, width) != (self.height, self.width):
            raise SequenceError(
                f"{self.paths[index]} is {width}x{height}, but {self.paths[0].name} is "
                f"{self.width}x{self.height}: all images of a sequence need one size; resize or remove it"
            )
        return image


def read_image(path: Path) -> Image:
    """Read an image as ``(H, W, 3)`` uint8 RGB; grey is repeated to three channels.

    Raises:
        SequenceError: if the file is missing, empty, truncated or no image.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SequenceError(f"cannot read image {path}: {error.strerror}") from error
    if not data:
        raise SequenceError(f"image {path} is empty: copy it again")
    if not _is_complete(data):
        raise SequenceError(f"image {path} is truncated at {len(data)} bytes: copy it again")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise SequenceError(f"image {path} cannot be decoded: {error.err or error}") from error
    if image is None:
        raise SequenceError(f"image {path} cannot be decoded: it is damaged or not an image; copy it again")
    rgb: Image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return rgb


def list_images(folder: Path) -> list[Path]:
    """The image files directly in a folder, in natural order (``2.png`` before ``10.png``).

    Raises:
        SequenceError: if two files differ in their suffix alone.
    """
    if not folder.is_dir():
        return []
    paths = [path for path in folder.iterdir() if _is_image(path)]
    doubles = [stem for stem, count in Counter(p.stem for p in paths).items() if count > 1]
    if doubles:
        raise SequenceError(f"{folder} has image {min(doubles)} in two formats: keep one file a frame")
    return sorted(paths, key=natural_key)


def has_images(folder: Path) -> bool:
    """Whether a folder holds an image file, without listing all of it."""
    return folder.is_dir() and any(_is_image(path) for path in folder.iterdir())


def natural_key(path: Path) -> list[tuple[int, str]]:
    """A sort key that compares runs of digits as numbers; ``img2`` comes before ``img10``."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]


def require_numbered(paths: list[Path]) -> None:
    """Require images named 0, 1, 2, ... without a gap, as KITTI names them.

    Raises:
        SequenceError: naming the first image that is missing or has no number for a name.
    """
    digits = len(paths[0].stem)
    for index, path in enumerate(paths):
        if not path.stem.isdecimal():
            raise SequenceError(f"{path} is not named by its number ({index:0{digits}d}{path.suffix}): rename it")
        if int(path.stem) != index:
            raise _missing(path.parent, f"{index:0{digits}d}{path.suffix}", len(paths))


def require_no_gap(paths: list[Path]) -> None:
    """Refuse a gap in a folder whose images are otherwise numbered one by one.

    Names without a number at their end, stamps and every-n-th-frame numbering pass.

    Raises:
        SequenceError: naming the first missing image.
    """
    matches = [re.fullmatch(r"(.*?)(\d+)", path.stem) for path in paths]
    names = [(match.group(1), match.group(2)) for match in matches if match is not None]
    if len(names) < len(paths) or len({prefix for prefix, _ in names}) != 1:
        return
    steps = np.diff([int(number) for _, number in names])
    if len(steps) == 0 or np.median(steps) != 1 or (steps == 1).all():
        return
    gap = int(np.argmax(steps != 1))
    prefix, number = names[gap]
    missing = f"{prefix}{int(number) + 1:0{len(number)}d}{paths[gap].suffix}"
    raise _missing(paths[gap].parent, missing, len(paths))


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


def _missing(folder: Path, name: str, count: int) -> SequenceError:
    return SequenceError(
        f"no image {name} in {folder}: the numbering of its {count} images has a gap there; "
        f"restore it or renumber the images"
    )


def _is_complete(data: bytes) -> bool:
    """Whether a JPEG or PNG file reaches its end marker; some decoders fill what is missing with grey."""
    if data.startswith(b"\xff\xd8"):
        return data.rfind(_JPEG_END) > data.rfind(_JPEG_SCAN)
    if data.startswith(_PNG_START):
        return data.rfind(_PNG_END) > 0
    return True
