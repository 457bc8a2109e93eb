"""Image files of one size as the frames of a sequence, and depth maps beside them; some frames may have no file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from erfsfm.common.readers.images import first_usual, read_image, read_values, stretch_of
from erfsfm.common.readers.numbering import NumberedFiles
from slam.frames import Image
from slam.runtime.errors import MissingFrameError, SequenceError

_MAX_GAP_FRAMES = 100


class Sized(Protocol):
    """Images of one size, pixels."""

    @property
    def width(self) -> int:
        """Of an image."""

    @property
    def height(self) -> int:
        """Of an image."""


class ImageSource(Sized, Protocol):
    """Images of one size, read one at a time."""

    def __len__(self) -> int:
        """Number of images."""

    def read(self, index: int, /) -> Image:
        """One image ``(height, width, 3)`` uint8 RGB.

        Args:
            index: row of the image, from 0.

        Raises:
            SequenceError: it cannot be read, or has another size; `MissingFrameError` where its
                number is missing.
            DataError: the file is damaged.
        """


@dataclass(frozen=True)
class ReadImages:
    """Images that a function reads."""

    width: int
    height: int
    count: int
    read: Callable[[int], Image]

    def __len__(self) -> int:
        """Number of images."""
        return self.count


class ImageFiles:
    """Images on disk, one row a number, all of the size of the first readable ones."""

    def __init__(self, files: NumberedFiles) -> None:
        """Read the first readable images for their size.

        Raises:
            SequenceError: a gap in the numbers is too long to be interpolated.
            DataError: no image can be read.
        """
        self.files = files
        for first, last in files.gaps():
            if last - first + 1 > _MAX_GAP_FRAMES:
                raise too_long(files, first, last)
        self._paths = dict(zip(files.rows, files.paths))
        self._stretch = stretch_of(files.paths, read_values)
        self._sized_by, image = first_usual(files.paths, read_image)
        self.height, self.width = image.shape[:2]

    def __len__(self) -> int:
        """Number of frames, with those without an image."""
        return len(self.files)

    def read(self, index: int) -> Image:
        """One image ``(height, width, 3)`` uint8 RGB.

        Raises:
            MissingFrameError: the frame's number is missing.
            SequenceError: the image has another size than the first.
            DataError: the image cannot be read.
        """
        path = self._paths.get(index)
        if path is None:
            folder = self.files.paths[0].parent
            raise MissingFrameError(
                f"no image {self.files.file_name(index)} in {folder}: the numbering has a gap there"
            )
        image = read_image(path, self._stretch)
        height, width = image.shape[:2]
        if (height, width) != (self.height, self.width):
            raise SequenceError(
                f"{path} is {width}x{height}, but {self._sized_by.name} is "
                f"{self.width}x{self.height}: all images of a sequence need one size; resize or remove it, "
                "or, where it lies on its side, the orientation in its EXIF"
            )
        return image


def too_long(files: NumberedFiles, first: int, last: int) -> SequenceError:
    """The error of a gap from row ``first`` to ``last``, too long to be interpolated."""
    return SequenceError(
        f"no images {files.file_name(first)} to {files.file_name(last)} in {files.paths[0].parent}: a gap of "
        f"{last - first + 1} frames is too long to interpolate; split the recording there"
    )
