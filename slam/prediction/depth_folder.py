"""Depth from a folder with one file a frame: arrays (.npy) or 16-bit pictures (.png)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from erfsfm.common.readers.images import natural_key, read_values
from erfsfm.common.readers.numbering import by_name
from slam.config.sections import DepthConfig
from slam.frames import DepthMap, Frame
from slam.prediction.depth_source import Disparity, Kind, at_size, disparity_of
from slam.runtime.errors import SlamError, sequence_errors

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER_BYTES = 26
Undistort = Callable[[DepthMap], DepthMap]  # z-depth (H, W) of a stored image to that of the undistorted one


@dataclass(frozen=True)
class FrameNumbers:
    """Which frames of a recording a run has: ``count`` from frame ``start`` of a recording of ``total``."""

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
        self._read: Callable[[Path], NDArray[Any]] = _pixels if suffix == "png" else _array
        self._folder = Path(path).expanduser()
        self._paths = _paths_of_frames(self._folder, suffix, numbers)
        self.sha256 = self._checked(_size_of_picture if suffix == "png" else lambda path: _array(path).shape)

    def disparity(self, frame: Frame) -> Disparity:
        """1/depth ``(h, w)`` of a frame, NaN where unknown.

        Raises:
            SlamError: its file is missing, or was changed since it was checked.
        """
        path = self._paths.get(frame.index)
        if path is None:
            raise SlamError(f"{self._folder} has no depth for frame {frame.index}: its number is missing, add the file")
        disparity = disparity_of(self._read(path) / self._scale, self._kind)
        if self._undistort is None:
            return disparity
        depth = np.asarray(1 / at_size(disparity, *self._size), np.float32)
        return disparity_of(self._undistort(depth), "depth")

    def _checked(self, size_of: Callable[[Path], tuple[int, ...]]) -> str:
        """SHA-256 of all names and files of the run's frames, whose sizes must agree."""
        digest = hashlib.sha256()
        sizes = {}
        for path in self._paths.values():
            try:
                sizes[size_of(path)] = path
                with path.open("rb") as file:
                    digest.update(path.name.encode() + b"\0" + hashlib.file_digest(file, "sha256").digest())
            except OSError as error:
                raise SlamError(f"cannot read depth {path}: {error.strerror or error}") from error
        if not sizes:
            raise SlamError(f"{self._folder} has no depth for the frames of this run: check depth.source")
        (height, width), *others = sizes
        if others:
            raise SlamError(
                f"{sizes[others[0]]} is {others[0][1]}x{others[0][0]}, others {width}x{height}: write all of one size"
            )
        if (height - width) * (self._size[0] - self._size[1]) < 0:
            raise SlamError(
                f"depth in {self._folder} is {width}x{height} (width x height) and the images are {self._size[1]}x"
                f"{self._size[0]}: write rows as rows, (height, width)"
            )
        return digest.hexdigest()


def _paths_of_frames(folder: Path, suffix: str, numbers: FrameNumbers) -> dict[int, Path]:
    """The file of each frame of a run; the folder covers the whole recording or just the run."""
    if not folder.is_dir():
        raise SlamError(f"no depth folder {folder}: check depth.source={suffix}:FOLDER")
    paths = [path for path in folder.iterdir() if path.suffix.lower() == f".{suffix}" and not path.name.startswith(".")]
    if not paths:
        raise SlamError(f"{folder} holds no .{suffix} file: give the folder with one .{suffix} file a frame")
    with sequence_errors():
        files = by_name(sorted(paths, key=natural_key))
    if len(files) not in (numbers.total, numbers.count):
        selected = "" if numbers.count == numbers.total else f", or {numbers.count}, the frames of this run"
        raise SlamError(
            f"{folder} has {len(files)} frames of .{suffix} (numbers that are missing between two are counted): give "
            f"one file a frame, {numbers.total} for the whole sequence{selected}"
        )
    before = numbers.start if len(files) == numbers.total else 0
    frames = {row - before: path for row, path in zip(files.rows, files.paths, strict=True)}
    return {index: path for index, path in frames.items() if 0 <= index < numbers.count}


def _array(path: Path) -> NDArray[Any]:
    """An array of floats ``(h, w)``, mapped from its file: nothing is executed, and headers alone are read."""
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise SlamError(
            f"{path} holds Python objects, which are not loaded, or is damaged ({error}): write it with numpy.save"
        ) from error
    if not isinstance(values, np.ndarray) or values.squeeze().ndim != 2 or not values.size or values.dtype.kind != "f":
        raise SlamError(f"{path} must hold one array of floats of shape (H, W): write it with numpy.save")
    return values.squeeze()


def _pixels(path: Path) -> NDArray[Any]:
    with sequence_errors():
        values = read_values(path)
    if values.ndim != 2 or values.dtype != np.uint16:
        raise SlamError(f"{path} was changed and is no 16-bit grey PNG any more: write it again")
    return values.astype(np.float64)


def _size_of_picture(path: Path) -> tuple[int, int]:
    """Height and width of a 16-bit grey PNG, by its header."""
    with path.open("rb") as file:
        header = file.read(_PNG_HEADER_BYTES)
    bits_and_colour = header[24:26] if header.startswith(_PNG_SIGNATURE) else b""
    if bits_and_colour != b"\x10\x00":
        raise SlamError(f"{path} is no 16-bit grey PNG, metres x 256 or as depth.png_scale: write depth so")
    return int.from_bytes(header[20:24]), int.from_bytes(header[16:20])
