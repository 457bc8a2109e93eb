"""A depth or disparity network from an ONNX file, by ONNX Runtime on the CPU.

Only operators of ONNX Runtime itself are run, and only the one file is read: a graph that needs code or weights from
elsewhere is refused.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from onnx.external_data_helper import convert_model_from_external_data
from onnxruntime.capi import onnxruntime_pybind11_state as state

from erfsfm.common.files import read_bytes
from erfsfm.common.processes import open_session
from erfsfm.common.readers.camera_file import MOST_PIXELS
from erfsfm.common.readers.images import resize_image
from erfsfm.inference import NETWORK_THREADS
from slam.config.sections import DepthConfig
from slam.frames import Frame, Image
from slam.prediction.depth_source import Disparity, Kind, disparity_of
from slam.runtime.errors import SlamError

_MOST_BYTES = 2**31  # of a message of Protocol Buffers
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_OWN_INPUT = "RGB in [-1, 1]"  # as `erfsfm export` writes it into the metadata


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
            raise SlamError(f"cannot read {self._path} ({error.strerror}): check depth.source=onnx:FILE") from error
        self.sha256 = hashlib.sha256(content).hexdigest()
        self._session, notes = self._opened(content)
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
        tensor = np.ascontiguousarray(tensor[(None,) * (len(self._shape) - 3)], _TYPES[self._input.type])
        try:
            (output,) = self._session.run([self._output], {self._input.name: tensor})
        except _errors() as error:
            raise SlamError(
                f"{self._path} fails on an image of {self._width}x{self._height}: {_short(error)}"
            ) from error
        found = np.asarray(output)
        sides = [side for side in found.shape if side != 1]
        if len(sides) != 2 or found.dtype.kind != "f" or found.size > MOST_PIXELS:
            raise SlamError(
                f"output {self._output} of {self._path} must be floats of one map (1, 1, H, W) of at most "
                f"{MOST_PIXELS:,} pixels; got {found.dtype} {found.shape}: choose another with depth.output_name"
            )
        return np.asarray(found.reshape(sides), dtype=np.float32)

    def _opened(self, content: bytes) -> tuple[onnxruntime.InferenceSession, dict[str, str]]:
        """A graph whose weights are all in its file, ready to run, and its metadata."""
        try:
            model = onnx.load_model_from_string(content)
            if not model.graph.node:
                raise DecodeError("no operators in it")
        except DecodeError as error:
            raise SlamError(f"{self._path} is damaged or no ONNX file ({error}): copy or export it again") from error
        try:
            convert_model_from_external_data(model)  # marks weights in other files as read, or finds that they are not
        except ValueError as error:
            reason = "keeps weights in other files, which are not read: save it as one file"
            raise SlamError(f"{self._path} {reason}") from error
        try:
            session = open_session(model.SerializeToString(), NETWORK_THREADS)
        except _errors() as error:
            raise SlamError(
                f"{self._path} cannot be run by onnxruntime {onnxruntime.__version__}, with its own operators alone: "
                f"{_short(error)}"
            ) from error
        return session, {entry.key: entry.value for entry in model.metadata_props}

    def _settings(self, config: DepthConfig, own: bool) -> tuple[Kind, NDArray[np.float32], NDArray[np.float32]]:
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
        mean, std = (np.array(given or half, np.float32) for given in (config.mean, config.std))
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
        if any(isinstance(fixed, int) and fixed != side for fixed, side in zip(sides, size, strict=True)):
            raise SlamError(
                f"{self._path} takes images of height and width {sides}, not {list(size)}: leave depth.size out"
            )
        return inputs[0], shape, size[0], size[1]

    def _depth_output(self, config: DepthConfig) -> str:
        names = [str(each.name) for each in self._session.get_outputs()]
        if config.output_name in names:
            return config.output_name
        if config.output_name or len(names) > 1:
            wanted = f"no output {config.output_name}" if config.output_name else f"{len(names)} outputs"
            raise SlamError(f"{self._path} has {wanted}: set depth.output_name to one of {', '.join(names)}")
        return names[0]


def _errors() -> tuple[type[Exception], ...]:
    """What ONNX Runtime raises: classes without a common base of their own."""
    own = [kind for kind in vars(state).values() if isinstance(kind, type) and issubclass(kind, Exception)]
    return (*own, RuntimeError, ValueError)


def _short(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else f"{text[:197]}..."
