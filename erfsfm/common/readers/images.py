"""Image files: which a folder holds, read completely or not at all, and the resizing that all parts share."""

from __future__ import annotations

import logging
import math
import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any, Self, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import DataError, OneLineError
from erfsfm.common.files import MAX_IMAGE_BYTES, read_bytes
from erfsfm.common.readers.camera_file import MOST_PIXELS

logger = logging.getLogger(__name__)

Image = NDArray[np.uint8]
T = TypeVar("T")

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")
IMAGE_FOLDERS = (
    "images",
    "image_2",
    "image_02",
    "image_0",
    "image_00",
    "rgb",
    "data",
)  # never a name of a drive
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_JPEG_SEGMENT = re.compile(
    rb"\xff[^\x00\x01\xd0-\xd8\xff]", re.DOTALL
)  # begins one with a length, or is the end
_PNG_START, _PNG_END, _PNG_BIT_DEPTH = b"\x89PNG", b"IEND", 24
_PNG_SIZE, _PNG_SIZE_AT = struct.Struct(">II"), 16  # width and height
# the segment that names height and width, after its length and the bits of a sample
_JPEG_FRAME = re.compile(rb"\xff[\xc0-\xc3\xc5-\xc7\xc9-\xcb\xcd-\xcf]")
_JPEG_SIZE, _JPEG_SIZE_AT = struct.Struct(">HH"), 3
_ENDS_PERCENT = (0.1, 99.9)  # of the values: what is beyond is black or white
_WIDE = 32768  # range of values from which on the upper eight bits show enough
_STRETCHED_BY = 16  # images of a recording
_COMPARED_IMAGES = 3
_NUMBER = re.compile(
    r"((?<![A-Za-z\d.])\d+\.\d+(?=\.\w+$)|\d+)"
)  # a stamp such as 1700000000.5 is one number


def list_images(folder: Path) -> list[Path]:
    """The image files directly in a folder, in natural order (``2.png`` before ``10.png``).

    Raises:
        DataError: an image is there in two formats.
    """
    if not folder.is_dir():
        return []
    paths = [path for path in folder.iterdir() if is_image(path)]
    stems: set[str] = set()
    doubles: set[str] = set()
    for path in paths:
        if path.stem in stems:
            doubles.add(path.stem)
        stems.add(path.stem)
    if doubles:
        raise DataError(f"{folder} has image {min(doubles)} in two formats: keep one file a frame")
    return sorted(paths, key=natural_key)


def has_images(folder: Path) -> bool:
    """Whether a folder holds an image file, without listing all of it."""
    return folder.is_dir() and any(map(is_image, folder.iterdir()))


def image_folder(folder: Path) -> Path | None:
    """The folder that holds the images: itself, or its one sub-folder of a usual name.

    Raises:
        DataError: several sub-folders have images.
    """
    if has_images(folder):
        return folder
    found = [folder / name for name in IMAGE_FOLDERS if has_images(folder / name)]
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise DataError(f"{folder} has images in {names}: give one of these folders as --dataset")
    return found[0] if found else None


def images_at(place: Path) -> list[Path]:
    """An image file, or those of a folder or of its one sub-folder of a usual name, in natural order.

    Raises:
        DataError: there are none, or several sub-folders have images.
    """
    if place.is_file():
        return [place]
    folder = image_folder(place) if place.is_dir() else None
    if folder is None:
        what = "no images in it" if place.is_dir() else "no such file or folder"
        raise DataError(f"{place}: {what}; give an image or a folder of png, jpg or bmp images")
    return list_images(folder)


def recording_folder(folder: Path) -> Path:
    """The folder that names a recording: this one, or its parent where it is only called ``images`` or the like."""
    folder = folder.absolute()
    return folder.parent if folder.name in IMAGE_FOLDERS and folder.parent.name else folder


def is_image(path: Path) -> bool:
    """Whether a file is an image by its name, and neither hidden nor the mask of a camera."""
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith((".", "mask."))


def natural_key(path: Path) -> list[tuple[Decimal, str]]:
    """A sort key that compares numbers in names: ``img2`` before ``img10``, the stamp ``7.12.png`` before ``7.5.png``.

    A point belongs to a number that ends the name and stands alone: not in ``cam0.12.png``.
    """
    key = []
    for place, part in enumerate(_NUMBER.split(path.name)):
        is_number = place % 2 == 1
        key.append((Decimal(part if is_number else 0), part))
    return key


@dataclass(frozen=True)
class Stretch:
    """How 16-bit values become eight bits: ``low`` black, ``high`` white, linearly; one for all images of a recording.

    Thermal cameras and sensors of 12 bits fill a part of the range, and how much differs from image to image: each
    stretched by itself would flicker.
    """

    low: float = 0.0
    high: float = 65535.0

    @classmethod
    def of(cls, images: Iterable[NDArray[np.uint16]]) -> Self:
        """The range of values of some images ``(H, W)`` or ``(H, W, C)``; the whole one where they fill half of it."""
        ends = [np.percentile(np.atleast_3d(values)[..., :3], _ENDS_PERCENT) for values in images]
        low, high = np.min(ends, axis=0)[0], np.max(ends, axis=0)[1]
        return cls() if high - low > _WIDE or high == low else cls(float(low), float(high))

    def apply(self, values: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """The values of the same shape."""
        if self == Stretch():
            return (values >> 8).astype(np.uint8)
        scaled = (values.astype(np.float32) - self.low) * (255.0 / (self.high - self.low))
        return np.asarray(np.clip(np.rint(scaled), 0, 255), np.uint8)


def read_image(path: Path, stretch: Stretch | None = None) -> Image:
    """Read an image as ``(H, W, 3)`` uint8 RGB; grey is repeated to three channels.

    Values of 16 bits are stretched; without a ``stretch`` by their own range.

    Raises:
        DataError: missing, empty, truncated or no image; one line.
    """
    return decode_image(_file_bytes(path), f"image {path}", stretch)


def decode_image(data: bytes, where: str, stretch: Stretch | None = None) -> Image:
    """As `read_image`, of the bytes of a file; ``where`` they come from is for messages."""
    if data.startswith(_PNG_START) and data[_PNG_BIT_DEPTH : _PNG_BIT_DEPTH + 1] == b"\x10":
        values = decode_values(data, where)
        grey_or_colour = np.atleast_3d(values)[..., :3]  # without alpha
        picture = (stretch or Stretch.of([values])).apply(grey_or_colour)
        return np.ascontiguousarray(np.broadcast_to(picture[..., ::-1], (*values.shape[:2], 3)))
    colour = decode_values(data, where, cv2.IMREAD_COLOR)
    return cv2.cvtColor(colour, cv2.COLOR_BGR2RGB)


def read_values(path: Path) -> NDArray[Any]:
    """An image's values as stored, such as a 16-bit depth map ``(H, W)``; errors as of `read_image`."""
    return decode_values(_file_bytes(path), f"image {path}")


def read_depth_map(path: Path, per_metre: float = 256.0, unknown: int = 0) -> NDArray[np.float64]:
    """A depth map ``(H, W)`` in metres, 0 where unknown, from a 16-bit grey PNG.

    ``per_metre`` is the stored value of one metre, ``unknown`` one of pixels without depth, beside 0.

    Raises:
        DataError: the file cannot be read, or is no 16-bit grey image.
    """
    values = read_values(path)
    if values.ndim != 2 or values.dtype != np.uint16:
        raise DataError(
            f"depth map {path} is no 16-bit grey PNG: write it again, or remove the folder"
        )
    return np.where(values == unknown, 0, values) / per_metre


def decode_values(data: bytes, where: str, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray[Any]:
    """As `read_values`, of the bytes of a file; ``where`` they come from is for messages, ``flags`` are OpenCV's.

    Raises:
        DataError: they are no image, or a part of one.
    """
    if not data:
        raise DataError(f"{where} is empty: copy it again")
    if not _is_complete(data):
        raise DataError(f"{where} is truncated or damaged: copy it again")
    too_many = DataError(f"{where} has more pixels than any camera: resize it, or leave it out")
    # the header is asked, for few kilobytes may unpack to gigabytes
    if _stored_pixels(data) > MOST_PIXELS:
        raise too_many
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        if "MAX_IMAGE_PIXELS" in str(error):
            raise too_many from error
        raise DataError(f"{where} cannot be decoded: {error.err or error}") from error
    if image is None:
        raise DataError(f"{where} cannot be decoded: it is damaged or not an image; copy it again")
    return image


def stretch_of(places: Sequence[T], read: Callable[[T], NDArray[Any]]) -> Stretch | None:
    """The stretch of a recording by some of its images, whose values are read; None where they have eight bits."""
    seen = []
    for place in places[:: max(len(places) // _STRETCHED_BY, 1)]:
        with suppress(OneLineError):
            values = read(place)
            if values.dtype != np.uint16:
                return None
            seen.append(values)
    return Stretch.of(seen) if seen else None


def first_usual(places: Sequence[T], read: Callable[[T], Image]) -> tuple[T, Image]:
    """The first readable image, and its place: of three, one of the size of most.

    Images have one size as a rule: recorders and people put another picture in front. Where ``read`` refuses all, its
    error for the first is raised.
    """
    found: dict[tuple[int, ...], tuple[T, Image]] = {}
    for place in places:
        with suppress(OneLineError):
            image = read(place)
            if image.shape in found:
                return found[image.shape]
            found[image.shape] = place, image
            if len(found) == _COMPARED_IMAGES:
                break
    return next(iter(found.values())) if found else (places[0], read(places[0]))


def first_size(files: Sequence[Path]) -> tuple[int, int]:
    """Height and width of the first readable image of the usual size; raises as `first_usual`."""
    height, width = first_usual(files, read_image)[1].shape[:2]
    return height, width


def report_unreadable(reasons: Sequence[str], total: int, what: str) -> None:
    """Warn once that some of many are left out, by the reason of the first; ``DataError`` where none can be read.

    Raises:
        DataError: all of them cannot be read.
    """
    if reasons and len(reasons) == total:
        raise DataError(
            reasons[0] if total == 1 else f"none of {total} {what} can be read: {reasons[0]}"
        )
    if reasons:
        logger.warning(
            "%d of %d %s cannot be read and are left out: %s", len(reasons), total, what, reasons[0]
        )


def resize_image(image: Image, height: int, width: int) -> Image:
    """An image ``(H, W, 3)`` at ``height x width``, without crop; the same in training and in inference."""
    if image.shape[:2] == (height, width):
        return image
    shrinks = image.shape[0] >= height and image.shape[1] >= width
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=method)


def _file_bytes(path: Path) -> bytes:
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise DataError(f"cannot read image {path}: it is a pipe or a device")
    try:
        return read_bytes(path, MAX_IMAGE_BYTES)
    except OSError as error:
        raise DataError(f"cannot read image {path}: {error.strerror}") from error


def _is_complete(data: bytes) -> bool:
    """Whether a JPEG or PNG file reaches its end, a PNG with all its checksums; some decoders fill in grey.

    The segments of a JPEG lead there; phones put a video behind it, with bytes of any value.
    """
    if data.startswith(_PNG_START):
        place, kind = _PNG_SIZE_AT - 8, b""
        while kind != _PNG_END and place + 8 < len(data):
            end = place + 8 + int.from_bytes(data[place : place + 4], "big")
            kind = data[place + 4 : place + 8]
            if zlib.crc32(data[place + 4 : end]).to_bytes(4, "big") != data[end : end + 4]:
                return False
            place = end + 4
        return kind == _PNG_END
    is_jpeg = data.startswith(_JPEG_START)
    return not is_jpeg or any(marker == _JPEG_END for marker, _ in _segments(data))


def _stored_pixels(data: bytes) -> int:
    """How many pixels the header of a PNG or JPEG file names, 0 of others."""
    if data.startswith(_PNG_START):
        return math.prod(_PNG_SIZE.unpack_from(data, _PNG_SIZE_AT))
    if data.startswith(_JPEG_START):
        for marker, place in _segments(data):
            if _JPEG_FRAME.match(marker):
                return math.prod(_JPEG_SIZE.unpack_from(data, place + _JPEG_SIZE_AT))
    return 0


def _segments(data: bytes) -> Iterator[tuple[bytes, int]]:
    """The markers of a JPEG file up to its end, and where each segment begins."""
    place = len(_JPEG_START)
    while found := _JPEG_SEGMENT.search(data, place):
        yield found[0], found.end()
        if found[0] == _JPEG_END:
            return
        place = found.end() + int.from_bytes(data[found.end() : found.end() + 2], "big")
