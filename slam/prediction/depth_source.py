"""Depth from elsewhere beside the pose network: another network's or from files, in its own unit.

Another network comes from an ONNX file and runs by ONNX Runtime on the CPU. Only operators of ONNX Runtime itself are
run, and only the one file is read: a graph that needs code or weights from elsewhere is refused. Files are a folder
with one a frame: arrays (.npy) or 16-bit pictures (.png).
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from erfsfm.common.files import read_bytes
from erfsfm.common.processes import open_session
from erfsfm.common.readers.camera_file import MOST_PIXELS
from erfsfm.common.readers.images import natural_key, read_values, resize_image
from erfsfm.common.readers.numbering import by_name
from erfsfm.inference import NETWORK_THREADS
from slam.config.sections import DepthConfig
from slam.frames import DepthMap, Frame, Image, Predictor, SnippetPoses
from slam.geometry.robust import mad_sigma
from slam.runtime.errors import SlamError, sequence_errors

logger = logging.getLogger(__name__)

Kind = Literal["depth", "disparity"]
Align = Literal["none", "scale", "affine"]
Disparity = NDArray[np.float32]

_COMPARED = 4096  # pixels of both depths that are compared in a frame
_LEAST_COMPARED = 50
_REWEIGHTINGS = 8
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER_BYTES = 26
# z-depth (H, W) of a stored image to that of the undistorted one
Undistort = Callable[[DepthMap], DepthMap]
_MOST_BYTES = 2**31  # of a message of Protocol Buffers
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_OWN_INPUT = "RGB in [-1, 1]"  # as `erfsfm export` writes it into the metadata


class DepthSource(Protocol):
    """Depth of the frames of one sequence in a unit of its own.

    ``name`` is that of the configuration, ``sha256`` that of the content.
    """

    name: str
    sha256: str

    def disparity(self, frame: Frame) -> Disparity:
        """1/depth ``(h, w)`` of any size, NaN where unknown.

        Args:
            frame: its image is ``(H, W, 3)``; a source of files reads its index alone.

        Raises:
            SlamError: the file of this frame is missing or was changed, or the network fails on its
                image.
        """


class SourcedPredictor:
    """Depth by a source, snippet poses by the networks, brought to one unit in each frame.

    The networks' own depth is the link: it has the unit of their poses.
    """

    def __init__(self, networks: Predictor, source: DepthSource, align: Align) -> None:
        """Combine both.

        Args:
            networks: depth and snippet poses in one unit.
            source: depth to use.
            align: ``none`` keeps the source's unit, which must be the same in all frames, and scales the poses to it;
                ``scale`` brings each frame's depth to the networks' unit; ``affine`` fits a shift of disparity as well.
        """
        self._networks = networks
        self._source = source
        self._align = align
        self._key = object()
        self.sources = networks.sources

    def executor(self) -> Executor:
        """That of the networks."""
        return self._networks.executor()

    def depth(self, frame: Frame) -> DepthMap:
        """Z-depth ``(H, W)`` at the image's size, NaN where unknown."""
        depth, unit = self._aligned(frame)
        if np.isnan(unit):
            logger.warning("frame %d has no known depth in %s", frame.index, self._source.name)
        return depth

    def snippet(self, frames: Sequence[Frame]) -> SnippetPoses:
        """Poses of the sources of a snippet in the unit of the target's depth, or the nearest known frame's.

        Raises:
            SlamError: no frame of the snippet has known depth.
        """
        snippet = self._networks.snippet(list(frames))
        if self._align != "none":
            return snippet
        T_source_target = snippet.T_source_target.copy()
        T_source_target[:, :3, 3] *= self._unit_near(snippet.target, frames)
        return replace(snippet, T_source_target=T_source_target)

    def _unit_near(self, target: int, frames: Sequence[Frame]) -> float:
        """The unit of the frame nearest to the target with known depth; of two as near the later."""
        by_distance = sorted(frames, key=lambda frame: (abs(frame.index - target), -frame.index))
        for frame in by_distance:
            _, unit = self._aligned(frame)
            if not np.isnan(unit):
                return unit
        raise SlamError(
            f"frames {frames[0].index} to {frames[-1].index} have no known depth in "
            f"{self._source.name} (zero, negative or not finite): check depth.kind and depth.source"
        )

    def _aligned(self, frame: Frame) -> tuple[DepthMap, float]:
        """Depth ``(H, W)``, and the source's unaligned depth over the networks', NaN where unknown."""
        return frame.derived((self._key, "aligned"), lambda: self._align_to_networks(frame))

    def _align_to_networks(self, frame: Frame) -> tuple[DepthMap, float]:
        height, width = frame.image.shape[:2]
        disparity = self._source.disparity(frame)
        disparity = at_size(disparity, height, width)
        step = max(int(np.sqrt(height * width / _COMPARED)), 1)
        own = disparity[::step, ::step].astype(np.float64)
        wanted = (1 / self._networks.depth(frame))[::step, ::step].astype(np.float64)
        known = np.isfinite(own)
        own, wanted = own[known], wanted[known]
        if len(own) < _LEAST_COMPARED:
            return np.full((height, width), np.nan, np.float32), np.nan
        near = wanted >= np.median(wanted)  # the half whose depth both know best
        unit = float(np.exp(np.median(np.log(wanted[near] / own[near]))))
        if self._align == "affine":
            gain, shift = _affine(own, wanted, unit)
            disparity = known_only(gain * disparity + shift)
        elif self._align == "scale":
            disparity = disparity * np.float32(unit)
        return np.asarray(1 / disparity, np.float32), unit


def known_only(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Depth or disparity in single precision, NaN where it is not finite or not positive."""
    with np.errstate(over="ignore"):
        single = np.asarray(values, dtype=np.float32)
    tiny = np.finfo(np.float32).tiny  # whose inverse is finite
    return np.where(np.isfinite(single) & (single >= tiny), single, np.float32(np.nan))


def disparity_of(values: NDArray[np.floating], kind: Kind) -> Disparity:
    """Disparity, NaN where unknown, from depth or disparity."""
    known = known_only(values)
    return known if kind == "disparity" else known_only(1 / known)


def at_size(disparity: Disparity, height: int, width: int) -> Disparity:
    """Disparity ``(height, width)`` from one of any size; unknown pixels are left out of the interpolation."""
    if disparity.shape == (height, width):
        return disparity
    known = np.isfinite(disparity)
    if known.all():
        return cv2.resize(disparity, (width, height), interpolation=cv2.INTER_LINEAR)
    shrinks = disparity.shape[0] >= height and disparity.shape[1] >= width
    method, least = (cv2.INTER_AREA, 1e-3) if shrinks else (cv2.INTER_LINEAR, 0.5)
    weight, total = (
        cv2.resize(part.astype(np.float32), (width, height), interpolation=method)
        for part in (known, np.where(known, disparity, 0))
    )
    return np.where(weight >= least, total / np.maximum(weight, least), np.float32(np.nan))


def _affine(
    own: NDArray[np.float64], wanted: NDArray[np.float64], gain: float
) -> tuple[np.float32, np.float32]:
    """Gain and shift from ``own`` to ``wanted`` disparity, by least squares with Cauchy weights.

    Where they would turn near into far, only a gain is fitted.
    """
    columns = np.stack([own, np.ones_like(own)], axis=1)
    fitted = np.array([gain, 0.0])
    for _ in range(_REWEIGHTINGS):
        residual = columns @ fitted - wanted
        sigma = max(mad_sigma(residual), 1e-12)
        weighted = columns / (1 + (residual / (2 * sigma)) ** 2)[:, None]
        fitted = np.linalg.lstsq(weighted.T @ columns, weighted.T @ wanted, rcond=None)[0]
    if fitted[0] <= 0:
        fitted = np.array([gain, 0.0])
    return np.float32(fitted[0]), np.float32(fitted[1])


@dataclass(frozen=True)
class FrameNumbers:
    """Which frames of a recording a run has: ``count`` from frame ``start`` of a recording of ``total``."""

    count: int
    start: int
    total: int


class DepthFolder:
    """Files of a folder in the order of their numbers, or names; each is checked before the first is used."""

    def __init__(
        self,
        config: DepthConfig,
        numbers: FrameNumbers,
        width: int,
        height: int,
        undistort: Undistort | None = None,
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
        self.sha256 = self._checked(
            _size_of_picture if suffix == "png" else lambda path: _array(path).shape
        )

    def disparity(self, frame: Frame) -> Disparity:
        """1/depth ``(h, w)`` of a frame, NaN where unknown.

        Raises:
            SlamError: its file is missing, or was changed since it was checked.
        """
        path = self._paths.get(frame.index)
        if path is None:
            raise SlamError(
                f"{self._folder} has no depth for frame {frame.index}: its number is missing, add the file"
            )
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
                    digest.update(
                        path.name.encode() + b"\0" + hashlib.file_digest(file, "sha256").digest()
                    )
            except OSError as error:
                raise SlamError(f"cannot read depth {path}: {error.strerror or error}") from error
        if not sizes:
            raise SlamError(
                f"{self._folder} has no depth for the frames of this run: check depth.source"
            )
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
    paths = [
        path
        for path in folder.iterdir()
        if path.suffix.lower() == f".{suffix}" and not path.name.startswith(".")
    ]
    if not paths:
        raise SlamError(
            f"{folder} holds no .{suffix} file: give the folder with one .{suffix} file a frame"
        )
    with sequence_errors():
        files = by_name(sorted(paths, key=natural_key))
    if len(files) not in (numbers.total, numbers.count):
        selected = (
            ""
            if numbers.count == numbers.total
            else f", or {numbers.count}, the frames of this run"
        )
        raise SlamError(
            f"{folder} has {len(files)} frames of .{suffix} (numbers that are missing between two are counted): give "
            f"one file a frame, {numbers.total} for the whole sequence{selected}"
        )
    before = numbers.start if len(files) == numbers.total else 0
    frames: dict[int, Path] = {}
    for row, path in zip(files.rows, files.paths, strict=True):
        if 0 <= row - before < numbers.count:
            frames[row - before] = path
    return frames


def _array(path: Path) -> NDArray[Any]:
    """An array of floats ``(h, w)``, mapped from its file: nothing is executed, and headers alone are read."""
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise SlamError(
            f"{path} holds Python objects, which are not loaded, or is damaged ({error}): write it with numpy.save"
        ) from error
    if (
        not isinstance(values, np.ndarray)
        or values.squeeze().ndim != 2
        or not values.size
        or values.dtype.kind != "f"
    ):
        raise SlamError(
            f"{path} must hold one array of floats of shape (H, W): write it with numpy.save"
        )
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
        raise SlamError(
            f"{path} is no 16-bit grey PNG, metres x 256 or as depth.png_scale: write depth so"
        )
    return int.from_bytes(header[20:24]), int.from_bytes(header[16:20])


class OnnxDepth:
    """Disparity of images by a network with one image input."""

    def __init__(self, config: DepthConfig) -> None:
        """Load a file and run it once, on a black image.

        Args:
            config: a source of kind ``onnx``.

        Raises:
            SlamError: a damaged file, one that is no such network, or settings missing.
        """
        self.name = config.source
        self._path = Path(config.source.partition(":")[2]).expanduser()
        try:
            content = read_bytes(self._path, _MOST_BYTES)
        except OSError as error:
            raise SlamError(
                f"cannot read {self._path} ({error.strerror}): check depth.source=onnx:FILE"
            ) from error
        self.sha256 = hashlib.sha256(content).hexdigest()
        try:
            self._session = open_session(content, NETWORK_THREADS)
        except Exception as error:  # ONNX Runtime raises classes of its own
            raise SlamError(
                f"{self._path} cannot be run by onnxruntime {onnxruntime.__version__}: {error}; copy or export "
                "it again, as one file with all weights and no operators of others"
            ) from error
        notes = self._session.get_modelmeta().custom_metadata_map
        self._input, self._shape, self._height, self._width = self._image_input(config)
        own = notes.get("input") == _OWN_INPUT and notes.get("kind") == "depth"
        self._kind, self._mean, self._std = self._settings(config, own)
        self._output = self._depth_output(config)
        self.infer(np.zeros((self._height, self._width, 3), np.uint8))

    def disparity(self, frame: Frame) -> Disparity:
        """1/depth at the network's own size, NaN where unknown; raises as ``infer``."""
        return disparity_of(self.infer(frame.image), self._kind)

    def infer(self, image: Image) -> NDArray[np.float32]:
        """The network's output ``(h, w)`` for an image ``(H, W, 3)`` uint8 RGB.

        Raises:
            SlamError: the network fails, or its output is no map.
        """
        resized = resize_image(image, self._height, self._width).astype(np.float32)
        values = resized / (255 * self._std) - self._mean / self._std  # (h, w, 3)
        tensor = values.transpose(2, 0, 1) if self._shape[-3] == 3 else values
        tensor = np.ascontiguousarray(
            tensor[(None,) * (len(self._shape) - 3)], _TYPES[self._input.type]
        )
        try:
            (output,) = self._session.run([self._output], {self._input.name: tensor})
        except Exception as error:  # likewise
            raise SlamError(
                f"{self._path} fails on an image of {self._width}x{self._height}: {error}"
            ) from error
        found = np.asarray(output)
        sides = [side for side in found.shape if side != 1]
        if len(sides) != 2 or found.dtype.kind != "f" or found.size > MOST_PIXELS:
            raise SlamError(
                f"output {self._output} of {self._path} must be floats of one map (1, 1, H, W) of at most "
                f"{MOST_PIXELS:,} pixels; got {found.dtype} {found.shape}: choose another with depth.output_name"
            )
        return np.asarray(found.reshape(sides), dtype=np.float32)

    def _settings(
        self, config: DepthConfig, own: bool
    ) -> tuple[Kind, NDArray[np.float32], NDArray[np.float32]]:
        """Kind of the output, mean and standard deviation of the input; those of our own exports are known."""
        missing = {
            "depth.kind=depth or disparity": config.kind == "auto",
            "depth.mean=[0.485,0.456,0.406]": config.mean is None,
            "depth.std=[0.229,0.224,0.225]": config.std is None,
        }
        wanted = [name for name, is_missing in missing.items() if is_missing]
        if wanted and not own:
            raise SlamError(
                f"{self._path} does not say what it takes and gives: set {', '.join(wanted)} (ImageNet's, or as the "
                "network was trained)"
            )
        kind: Kind = "disparity" if config.kind == "auto" else config.kind
        half = (0.5, 0.5, 0.5)
        mean = np.array(config.mean or half, np.float32)
        std = np.array(config.std or half, np.float32)
        return kind, mean, std

    def _image_input(self, config: DepthConfig) -> tuple[Any, list[Any], int, int]:
        """The one input, its shape, and the height and width of its image."""
        inputs = self._session.get_inputs()
        described = ", ".join(f"{each.name} {each.type} {each.shape}" for each in inputs)
        shape = list(inputs[0].shape) if len(inputs) == 1 else []
        channels_first = len(shape) in (3, 4) and shape[-3] == 3
        channels_last = len(shape) in (3, 4) and shape[-1] == 3
        is_batch = len(shape) == 4 and isinstance(shape[0], int) and shape[0] != 1
        if not (channels_first or channels_last) or is_batch or inputs[0].type not in _TYPES:
            raise SlamError(
                f"{self._path} must have one input, an RGB image (1, 3, H, W) or (1, H, W, 3) of floats; got "
                f"{described}"
            )
        sides = shape[-2:] if channels_first else shape[-3:-1]
        size = config.size or sides
        if not all(isinstance(side, int) for side in size):
            raise SlamError(
                f"{self._path} takes images of any size: set depth.size=[HEIGHT,WIDTH], such as that of its training"
            )
        if any(
            isinstance(fixed, int) and fixed != side
            for fixed, side in zip(sides, size, strict=True)
        ):
            raise SlamError(
                f"{self._path} takes images of height and width {sides}, not {list(size)}: leave depth.size out"
            )
        return inputs[0], shape, size[0], size[1]

    def _depth_output(self, config: DepthConfig) -> str:
        names = [str(each.name) for each in self._session.get_outputs()]
        if config.output_name in names:
            return config.output_name
        if config.output_name or len(names) > 1:
            wanted = (
                f"no output {config.output_name}" if config.output_name else f"{len(names)} outputs"
            )
            raise SlamError(
                f"{self._path} has {wanted}: set depth.output_name to one of {', '.join(names)}"
            )
        return names[0]
