"""Inference with trained networks, the interface for other packages: NumPy in, NumPy out."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from ctypes.util import find_library
from functools import cache, lru_cache, partial
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from erfsfm.common.errors import CheckpointError, ConfigError, DataError
from erfsfm.common.processes import usable_cores
from erfsfm.common.readers.camera_file import MOST_PIXELS, Pinhole
from erfsfm.common.readers.frame_range import overlapping
from erfsfm.common.readers.images import read_image as read_image  # images are read as for training
from erfsfm.common.readers.images import resize_image
from erfsfm.config import NetworkKind
from erfsfm.model_record import ModelRecord, find_weights, read_record, weights_sha256
from erfsfm.model_record import commit as commit  # likewise
from erfsfm.model_record import record_of_whole_weights as record_of_whole_weights
from erfsfm.networks.onnx_graph import OnnxGraph
from erfsfm.snippet_motion import LIKE_KITTI, Followed, followed, measured

if (
    TYPE_CHECKING
):  # PyTorch takes seconds to import, and is needed only where no graph of the networks is kept
    from torch import nn

    from erfsfm.checkpoint import Model

_BFLOAT16 = ("avx512_bf16", "amx_bf16", "bf16", "sve_bf16")  # capabilities of a processor
Array = NDArray[np.float32]
Device = Literal["cpu", "cuda"]
Runtime = Literal["torch", "onnx"]
Network = Callable[..., Array]
_GPU_DRIVERS = ("nvidiactl", "dxg", "kfd")  # of Nvidia, of WSL, and of AMD
NETWORK_THREADS = max(usable_cores() - 1, 1)  # one core stays free for other threads


def limit_torch_threads() -> None:
    """Let PyTorch, where it is used, take all cores but one in this thread, which stays free for other threads."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(NETWORK_THREADS)


def has_bfloat16() -> bool:
    """Whether the CPU computes with bfloat16; without instructions for it, it takes six times as long as float32."""
    import torch

    able = torch.cpu.get_capabilities()
    return any(able.get(name) for name in _BFLOAT16)


def choose_device(choice: str) -> Device:
    """``auto`` is the GPU where there is one.

    Raises:
        ConfigError: ``cuda`` where there is none, or an unknown word.
    """
    if choice not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"device must be auto, cpu or cuda; got '{choice}'")
    available = choice == "cuda" or (choice == "auto" and _may_have_gpu())
    if available:
        import torch

        available = torch.cuda.is_available()
    if choice == "cuda" and not available:
        raise ConfigError(
            "device cuda is not available on this machine or in this build of torch; use cpu"
        )
    return "cuda" if available else "cpu"


def _may_have_gpu() -> bool:
    """Whether PyTorch was built for one and a driver is there; otherwise it need not be imported to be asked."""
    has_driver = any(Path("/dev", name).exists() for name in _GPU_DRIVERS) or find_library("cuda")
    return not version("torch").endswith("+cpu") and bool(has_driver)


@lru_cache(maxsize=1)
def _graphs(folder: Path, sha256: str) -> dict[NetworkKind, OnnxGraph]:
    """Of the weights with this digest, each made by PyTorch only where it is not kept on disk."""
    record = read_record(folder / "model.yaml")
    config = record.network

    @cache
    def model() -> Model:
        from erfsfm.checkpoint import load_model

        return load_model(folder)

    def network(kind: NetworkKind) -> nn.Module:
        return model().networks[kind]

    graphs = {
        kind: OnnxGraph(partial(network, kind), NETWORK_THREADS, f"{kind} {sha256} {config!r}")
        for kind in record.kinds
    }
    if "depth" not in graphs or not graphs["depth"].is_kept((1, 3, config.height, config.width)):
        model()  # damaged weights are found before the first image
    return graphs


class DepthPosePredictor:
    """Depth of single images and poses of snippets, each in an unknown scale."""

    origin: str = "these weights"

    def __init__(
        self,
        record: ModelRecord,
        networks: Mapping[NetworkKind, Network],
        device: Device,
        sha256: str = "",
    ) -> None:
        self.device = device
        self.record = record
        self.sha256 = sha256
        self.sources: int = record.network.sources
        self._networks = networks
        self._steps: deque[tuple[Array, Array, Followed]] = deque(maxlen=self.sources)

    @classmethod
    def of(cls, model: Model, device: str = "cpu", sha256: str = "") -> DepthPosePredictor:
        """Of networks in memory, by PyTorch.

        Raises:
            ConfigError: a device that is not there.
        """
        from erfsfm.networks.torch_network import TorchNetwork

        chosen = choose_device(device)
        networks = {kind: TorchNetwork(network, chosen) for kind, network in model.networks.items()}
        return cls(model.record, networks, chosen, sha256)

    @classmethod
    def from_weights(
        cls, name_or_dir: str | Path, device: str = "cpu", runtime: Runtime = "torch"
    ) -> DepthPosePredictor:
        """Load a shipped model by name or a training output folder.

        Args:
            name_or_dir: the weights.
            device: auto, cpu or cuda.
            runtime: on a CPU, ``onnx`` gives the same outputs up to rounding in less time. Its graphs are made at the
                first call, in some two seconds, and kept on disk; from then on PyTorch is not imported.

        Raises:
            CheckpointError: missing or damaged weights.
            ConfigError: a device that is not there.
        """
        folder, chosen = find_weights(name_or_dir), choose_device(device)
        sha256 = weights_sha256(folder)
        if runtime == "onnx" and chosen == "cpu":
            predictor = cls(
                read_record(folder / "model.yaml"), _graphs(folder, sha256), chosen, sha256
            )
        else:
            from erfsfm.checkpoint import load_model

            predictor = cls.of(load_model(folder), chosen, sha256)
        predictor.origin = str(folder)
        return predictor

    def leaks(self, names: Sequence[str]) -> list[str]:
        """The given recordings (``kitti_odometry/00[0:300]``) that were trained on."""
        return overlapping(names, self.record.trained_on)

    def depth(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Unscaled z-depth of an image.

        Args:
            image: ``(H, W, 3)`` uint8 RGB of any size.

        Returns:
            ``(H, W)`` float32, positive, at the image's size. Disparity is what is interpolated. The network may see
            the image larger than in its training (`ModelRecord.depth_input`).
        """
        require_image(image)
        size = self.record.depth_input
        if size is None:
            disparity = self.disparity(image)
        else:
            larger = _input(image, size.height, size.width)
            disparity = self.disparity(larger) * np.float32(size.disparity)
        return depth_at(disparity, *image.shape[:2])

    def prepare(self, image: NDArray[np.uint8] | Array) -> Array:
        """An image ``(H, W, 3)`` uint8 RGB as the networks take it, for several calls on the same image.

        Returns:
            ``(1, 3, h, w)`` in [-1, 1] at the size of the training; an image that was prepared stays as it is.
        """
        if isinstance(image, np.ndarray) and image.ndim == 4 and image.dtype == np.float32:
            return np.asarray(image, np.float32)
        network = self.record.network
        return _input(image, network.height, network.width)

    def disparity(self, image: NDArray[np.uint8] | Array) -> NDArray[np.float32]:
        """Unscaled 1/depth of an image ``(H, W, 3)`` uint8 RGB, float32 at the size of the training, as of a snippet.

        Args:
            image: the image, or what `prepare` made of it.

        Raises:
            CheckpointError: there is no depth network, or its output is not finite.
        """
        return self._output("depth", self.prepare(image))[0]

    def poses(
        self, images: Sequence[NDArray[np.uint8] | Array], camera: Pinhole | None = None
    ) -> NDArray[np.float64]:
        """Poses of a snippet's sources.

        Args:
            images: N + 1 frames ``(H, W, 3)`` uint8 RGB in time order, the target in the middle, or what `prepare`
                made of them.
            camera: of the images, at any size, where the motion is measured; without it one like KITTI's.

        Returns:
            ``T_source_target`` ``(N, 4, 4)``, target camera to source camera, unscaled; row k belongs to
            the k-th source in time order.

        Raises:
            ValueError: another number of images than the networks were trained for, or several sizes.
            CheckpointError: there is no pose network, or its output is not finite.
        """
        inputs = self._inputs(images)
        return self.measured_poses(self.guessed_poses(inputs), inputs, camera)

    @property
    def measures(self) -> bool:
        """Whether the pose network's guess is the start of a measurement in the images."""
        return self.record.network.alignment == "images"

    def measured_poses(
        self,
        guess: NDArray[np.float64],
        images: Sequence[NDArray[np.uint8] | Array],
        camera: Pinhole | None,
    ) -> NDArray[np.float64]:
        """As `poses`, from their `guessed_poses`, which stay where nothing is measured."""
        if not self.measures:
            return guess
        network = self.record.network
        steps = [self._followed(*pair) for pair in pairwise(self._inputs(images))]
        return measured(guess, steps, (camera or LIKE_KITTI).resized(network.width, network.height))

    def guessed_poses(self, images: Sequence[NDArray[np.uint8] | Array]) -> NDArray[np.float64]:
        """As `poses`, by the pose network alone."""
        inputs, middle = self._inputs(images), self.sources // 2
        sources = inputs[:middle] + inputs[middle + 1 :]
        vectors = self._output("pose", inputs[middle], sources).astype(np.float64)
        T_source_target = np.tile(np.eye(4), (len(vectors), 1, 1))
        T_source_target[:, :3, :3] = Rotation.from_euler("XYZ", vectors[:, 3:]).as_matrix()
        T_source_target[:, :3, 3] = vectors[:, :3]
        return T_source_target

    def _inputs(self, images: Sequence[NDArray[np.uint8] | Array]) -> list[Array]:
        """The images of a snippet as the networks take them."""
        if len(images) != self.sources + 1:
            raise ValueError(f"a snippet must have {self.sources + 1} images; got {len(images)}")
        if len(sizes := {image.shape for image in images if image.ndim == 3}) > 1:
            raise ValueError(f"images of a snippet must have one size; got {sorted(sizes)}")
        return [self.prepare(image) for image in images]

    def _followed(self, image: Array, after: Array) -> Followed:
        """Corners of a prepared image in the next one; snippets that overlap share them."""
        for first, second, step in self._steps:
            if first is image and second is after:
                return step
        step = followed(
            *(np.round((each[0, 1] + 1) * 127.5).astype(np.uint8) for each in (image, after))
        )  # of green
        self._steps.append((image, after, step))
        return step

    def _output(self, kind: NetworkKind, *inputs: Array | list[Array]) -> Array:
        """Of a network for one input, refused where it is not finite: float16 weights may overflow in the pass."""
        if kind not in self._networks:
            raise CheckpointError(
                f"{self.origin} holds no {kind} network: use weights that have both"
            )
        output: Array = self._networks[kind](*inputs)[0]
        if not np.isfinite(output).all():
            raise CheckpointError(
                f"the {kind} network of {self.origin} gives NaN or infinity: use other weights"
            )
        return output


def refuse_leak(networks: DepthPosePredictor, names: Sequence[str], allow_leak: bool) -> bool:
    """Whether some of the frames were trained on.

    Args:
        networks: whose record is asked.
        names: of recordings or of their frames, as the leak record writes them.
        allow_leak: only tell.

    Raises:
        DataError: some were, and that is not allowed.
    """
    leaked = networks.leaks(names)
    if leaked and not allow_leak:
        some = ", ".join(leaked[:5]) + (f" and {len(leaked) - 5} more" if len(leaked) > 5 else "")
        raise DataError(
            f"leak: these weights were trained on {some}; choose other weights or data, or --allow-leak"
        )
    return bool(leaked)


def learned_inverse_depth(weights: str, image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """``(H, W)``, unscaled, of an image ``(H, W, 3)``, by networks that this process reads once."""
    return np.reciprocal(_predictor(weights).depth(image))


_predictor = lru_cache(maxsize=1)(
    partial(DepthPosePredictor.from_weights, device="cpu", runtime="onnx")
)


def _input(image: NDArray[np.uint8] | Array, height: int, width: int) -> Array:
    """An image at a network's size, in [-1, 1], ``(1, 3, height, width)``."""
    require_image(image)
    resized = resize_image(np.asarray(image, np.uint8), height, width)
    scaled = resized.astype(np.float32) / np.float32(127.5) - np.float32(1)
    return np.ascontiguousarray(scaled.transpose(2, 0, 1)[None])


def require_image(image: object) -> None:
    """Refuse what is no image ``(H, W, 3)`` uint8, and more pixels than any camera has.

    Raises:
        ValueError: naming what came.
    """
    shape, kind = getattr(image, "shape", None), getattr(image, "dtype", type(image).__name__)
    if (
        not isinstance(image, np.ndarray)
        or image.ndim != 3
        or image.shape[2] != 3
        or kind != np.uint8
        or not image.size
    ):
        raise ValueError(f"image must be (H, W, 3) uint8 RGB; got {shape} {kind}")
    if image.size > 3 * MOST_PIXELS:
        raise ValueError(f"image must have {MOST_PIXELS:,} pixels at most; got {shape}: resize it")


def depth_at(disparity: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Depth ``(height, width)`` from disparity ``(h, w)`` at the networks' size, both unscaled."""
    if disparity.shape != (height, width):
        disparity = np.asarray(
            cv2.resize(disparity, (width, height), interpolation=cv2.INTER_LINEAR), np.float32
        )
    return np.asarray(1 / disparity, dtype=np.float32)


def colour_disparity(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """A picture ``(H, W, 3)`` RGB of 1/depth: near is bright, the nearest 2 % saturate, unknown is black."""
    is_known = np.isfinite(depth) & (depth > 0)
    disparity = 1 / np.where(is_known, depth, np.float32(np.inf))
    low, high = np.percentile(disparity[is_known], [1, 98]) if is_known.any() else (0.0, 1.0)
    shade = np.clip((disparity - low) / max(high - low, 1e-9) * 255, 0, 255).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(shade, cv2.COLORMAP_MAGMA)[..., ::-1])
