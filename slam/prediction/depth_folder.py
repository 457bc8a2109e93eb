"""Depth from a folder with one file a frame: arrays (.npy) or 16-bit pictures (.png)."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.files import MAX_IMAGE_BYTES, read_bytes
from erfsfm.common.readers.images import natural_key, read_values
from erfsfm.common.readers.numbering import by_name
from erfsfm.common.readers.pinhole import MOST_PIXELS
from slam.config.sections import DepthConfig
from slam.frames import DepthMap, Frame
from slam.prediction.depth_source import Disparity, Kind, at_size, disparity_of
from slam.runtime.errors import SlamError, sequence_errors

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER_BYTES = 26
Undistort = Callable[[DepthMap], DepthMap]  # z-depth (H, W) of a stored image to that of the undistorted one


@dataclass(frozen=True)
class FrameNumbers:
    """Which frames of a recording a run has.

    ``count`` frames from frame ``start`` of a recording of ``total``.
    """

    count: int
    start: int
    total: int


class DepthFolder:
    """Files of a folder in the order of their numbers, or names; each is checked before the first is used."""

    def __init__(
        self, config: DepthConfig, numbers: FrameNumbers, width: int, height: int, undistort: Undistort | None = None
    ) -> None:
        """Check the files of the frames of a run.

        Args:
            config: a source of kind ``npy`` or ``png``.
            numbers: of the frames.
            width, height: of the images.
            undistort: for files of distorted images that are undistorted as they are read.

        Raises:
            SlamError: no such folder, another number of files than frames, or a file that is no depth map.
        """
        self.name = config.source
        suffix, _, path = config.source.partition(":")
        self._kind: Kind = "disparity" if config.kind == "disparity" else "depth"
        self._scale = config.png_scale if suffix == "png" else 1.0
        self._size, self._undistort = (height, width), undistort
        self._read: Callable[[Path], NDArray[Any]] = _read_png if suffix == "png" else _read_npy
        folder = Path(path).expanduser()
        paths = _listed(folder, suffix)
        with sequence_errors():
            files = by_name(paths)
        before = _frames_before(folder, suffix, len(files), numbers)
        self._folder = folder
        self._rows = {row - before: file for row, file in zip(files.rows, files.paths, strict=True)}
        self._range = range(numbers.count)
        self.sha256 = self._checked(_header_of_png if suffix == "png" else _header_of_npy, width, height)

    def disparity(self, frame: Frame) -> Disparity:
        """1/depth ``(h, w)`` of a frame, NaN where unknown.

        Raises:
            SlamError: its file is missing, or was changed since it was checked.
        """
        path = self._rows.get(frame.index)
        if path is None:
            raise SlamError(f"{self._folder} has no depth for frame {frame.index}: its number is missing, add the file")
        with sequence_errors():
            values = self._read(path)
        disparity = disparity_of(values / self._scale, self._kind)
        if self._undistort is None:
            return disparity
        depth = np.asarray(1 / at_size(disparity, *self._size), np.float32)
        return disparity_of(self._undistort(depth), "depth")

    def _checked(self, header: Callable[[Path, bytes], tuple[int, int]], width: int, height: int) -> str:
        """SHA-256 of all names and files of the run's frames, whose sizes must agree."""
        digest = hashlib.sha256()
        size: tuple[int, int] | None = None
        for index in self._range:
            path = self._rows.get(index)
            if path is None:  # the image may be missing as well
                continue
            try:
                content = read_bytes(path, MAX_IMAGE_BYTES)
            except OSError as error:
                raise SlamError(f"cannot read depth {path}: {error.strerror or error}") from error
            found = header(path, content)
            size = size or found
            if size[0] * size[1] > MOST_PIXELS:
                raise SlamError(f"{path} is {found[1]}x{found[0]}, more pixels than any camera has: resize it")
            if found != size:
                raise SlamError(
                    f"{path} is {found[1]}x{found[0]}, the depth before it {size[1]}x{size[0]}: write all of one size"
                )
            digest.update(path.name.encode() + b"\0" + hashlib.sha256(content).digest())
        if size is None:
            raise SlamError(f"{self._folder} has no depth for the frames of this run: check depth.source")
        if (size[0] - size[1]) * (height - width) < 0:
            raise SlamError(
                f"depth in {self._folder} is {size[1]}x{size[0]} (width x height) and the images are {width}x{height}: "
                "write rows as rows, (height, width)"
            )
        return digest.hexdigest()


def _listed(folder: Path, suffix: str) -> list[Path]:
    if not folder.is_dir():
        raise SlamError(f"no depth folder {folder}: check depth.source={suffix}:FOLDER")
    paths = [path for path in folder.iterdir() if path.suffix.lower() == f".{suffix}" and not path.name.startswith(".")]
    if not paths:
        raise SlamError(f"{folder} holds no .{suffix} file: give the folder with one .{suffix} file a frame")
    return sorted(paths, key=natural_key)


def _frames_before(folder: Path, suffix: str, found: int, numbers: FrameNumbers) -> int:
    """How many frames of the folder come before the run's first: it covers the recording or just the run."""
    if found == numbers.total:
        return numbers.start
    if found == numbers.count:
        return 0
    selected = "" if numbers.count == numbers.total else f", or {numbers.count}, the frames of this run"
    raise SlamError(
        f"{folder} has {found} frames of .{suffix} (numbers that are missing between two are counted): give one file a "
        f"frame, {numbers.total} for the whole sequence{selected}"
    )


def _read_npy(path: Path) -> NDArray[Any]:
    try:
        content = read_bytes(path, MAX_IMAGE_BYTES)
        _header_of_npy(path, content)
        return np.asarray(np.load(io.BytesIO(content), allow_pickle=False).squeeze())
    except OSError as error:
        raise SlamError(f"cannot read depth {path}: {error.strerror or error}") from error
    except (ValueError, EOFError) as error:
        raise SlamError(f"depth {path} is damaged ({error}): write it again") from error


def _header_of_npy(path: Path, content: bytes) -> tuple[int, int]:
    """Height and width of an array of floats; nothing in the file is executed."""
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
    except (ValueError, EOFError) as error:
        raise SlamError(f"{path} is no .npy array ({error}): write it with numpy.save") from error
    if dtype.hasobject:
        raise SlamError(f"{path} holds Python objects, which are not loaded: save an array of floats (H, W)")
    size = tuple(side for side in shape if side != 1)
    if len(size) != 2 or 0 in size or dtype.kind != "f":
        raise SlamError(f"{path} must hold floats of shape (H, W); got {dtype} {shape}")
    if len(content) - file.tell() < dtype.itemsize * size[0] * size[1]:
        raise SlamError(f"depth {path} is truncated at {len(content)} bytes: write it again")
    return size


def _read_png(path: Path) -> NDArray[Any]:
    values = read_values(path)
    if values.ndim != 2 or values.dtype != np.uint16:
        raise SlamError(f"{path} was changed and is no 16-bit grey PNG any more: write it again")
    return values.astype(np.float64)


def _header_of_png(path: Path, content: bytes) -> tuple[int, int]:
    """Height and width of a 16-bit grey PNG."""
    if not content.startswith(_PNG_SIGNATURE) or len(content) < _PNG_HEADER_BYTES:
        raise SlamError(f"{path} is no PNG: write depth as 16-bit grey PNG")
    bits, colour = content[24], content[25]
    if (bits, colour) != (16, 0):
        kind = "grey" if colour in (0, 4) else "colour"
        raise SlamError(
            f"{path} is a {kind} picture of {bits} bits: depth is a 16-bit grey PNG, metres x 256 or as depth.png_scale"
        )
    return int.from_bytes(content[20:24]), int.from_bytes(content[16:20])
