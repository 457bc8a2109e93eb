"""Inference with trained networks, the interface for other packages: NumPy in, NumPy out."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, Self, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from erfsfm.checkpoint import FILES, Model, find_weights, load_model, weights_sha256
from erfsfm.checkpoint import commit as commit  # for slam, which imports only this module
from erfsfm.data.splits import overlapping as overlapping  # likewise
from erfsfm.errors import CheckpointError, ConfigError, DataError
from erfsfm.files import write_atomically
from erfsfm.geometry.transforms import pose_vector_to_matrix
from erfsfm.networks.lite0_pose import Lite0PoseNet
from erfsfm.networks.onnx_graph import OnnxGraph
from erfsfm.pose_noise import NOISE_FILE, PoseNoise, file_sha256, read_pose_noise
from erfsfm.readers.images import read_image as read_image  # images are read as for training
from erfsfm.readers.images import resize_image

logger = logging.getLogger(__name__)

F = TypeVar("F", np.float32, np.float64)
DeviceChoice = Literal["auto", "cpu", "cuda"]
Network = Callable[..., Tensor]
NETWORK_THREADS = max(torch.get_num_threads() - 1, 1)  # one core stays free for other threads


def limit_torch_threads() -> None:
    """Let PyTorch in this thread use all cores but one, which stays free for other threads."""
    torch.set_num_threads(NETWORK_THREADS)


def choose_device(choice: str) -> torch.device:
    """``auto`` is the GPU where there is one.

    Raises:
        ConfigError: ``cuda`` where there is none, or an unknown word.
    """
    if choice not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"device must be auto, cpu or cuda; got '{choice}'")
    if choice == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device cuda is not available on this machine or in this build of torch; use cpu")
    return torch.device("cuda" if choice != "cpu" and torch.cuda.is_available() else "cpu")


@dataclass
class PreparedImage:
    """An image as a predictor's networks take it: resized, in [-1, 1], ``(1, 3, h, w)``.

    ``features`` are those of a pose network that encodes each image by itself, once they were asked for.
    """

    tensor: Tensor
    features: Tensor | None = None


class _Networks(NamedTuple):
    depth: Network
    pose: Network
    features: Network | None  # of one image, for a pose network that encodes each by itself

    def as_graphs(self, identity: str) -> _Networks:
        features = self.features and _graph(self.features, identity and f"features {identity}")
        depth, pose = (_graph(getattr(self, name), identity and f"{name} {identity}") for name in ("depth", "pose"))
        return _Networks(depth, pose, features)


def _graph(network: Network, identity: str) -> Network:
    return OnnxGraph(network, NETWORK_THREADS, identity) if isinstance(network, nn.Module) else network


_graphs: dict[tuple[object, str], _Networks] = {}  # of the last weights in this process


class DepthPosePredictor:
    """Depth of single images and poses of snippets, in one unknown scale.

    ``noise`` is the noise model of the poses if it was measured with these weights, else None; ``noise_sha256`` is that
    of its file.
    """

    noise: PoseNoise | None = None
    noise_sha256: str = ""
    pose_sha256: str = ""
    origin: str = "these weights"

    def __init__(self, model: Model, device: str = "cpu", sha256: str = "") -> None:
        self.device = choose_device(device)
        self.record = model.record
        self.sha256 = sha256
        self.sources: int = model.record.network.sources
        depth_net, pose_net = model.depth_net, model.pose_net
        for network in (depth_net, pose_net):
            network.eval().to(self.device)
            if self.device.type == "cpu":  # images are channels-last, and small kernels are faster so
                network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._networks = _Networks(depth_net, pose_net, None)
        if isinstance(pose_net, Lite0PoseNet):
            self._networks = _Networks(depth_net, _Motion(pose_net).eval(), _Features(pose_net).eval())

    @classmethod
    def from_weights(cls, name_or_dir: str | Path, device: str = "cpu") -> DepthPosePredictor:
        """Load a shipped model by name or a training output folder.

        Raises:
            CheckpointError: missing or damaged weights, or a damaged noise.yaml beside them.
            ConfigError: a device that is not there.
        """
        folder = find_weights(name_or_dir)
        predictor = cls(load_model(folder), device, weights_sha256(folder))
        predictor.origin = str(folder)
        predictor.pose_sha256 = file_sha256(folder / FILES[1])
        noise = read_pose_noise(folder)
        if noise is not None and noise.pose_sha256 != predictor.pose_sha256:
            logger.warning(
                "%s was measured with other weights and is not used: run erfsfm calibrate-noise again",
                folder / NOISE_FILE,
            )
        elif noise is not None:
            predictor.noise, predictor.noise_sha256 = noise, file_sha256(folder / NOISE_FILE)
        return predictor

    def freeze(self) -> Self:
        """On a CPU, run the networks by ONNX Runtime: the same outputs up to rounding, in less time.

        The graphs are made at the first call, in some two seconds, and kept on disk and for the next predictor of these
        weights.
        """
        if self.device.type == "cpu":
            key = (self.sha256 or object(), repr(self.record.network))
            if key not in _graphs:
                _graphs.clear()
                _graphs[key] = self._networks.as_graphs(self.sha256 and " ".join(map(str, key)))
            self._networks = _graphs[key]
        return self

    def leaks(self, names: Sequence[str]) -> list[str]:
        """Those of the given recordings (``kitti_odometry/00[0:300]``) that were trained on."""
        return overlapping(names, self.record.trained_on)

    def depth(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Unscaled z-depth of an image.

        Args:
            image: ``(H, W, 3)`` uint8 RGB of any size.

        Returns:
            ``(H, W)`` float32, positive, at the image's size. Disparity is what is interpolated.
        """
        require_image(image)
        height, width = image.shape[:2]
        return depth_at(self.disparity(image), height, width)

    def prepare(self, image: NDArray[np.uint8]) -> PreparedImage:
        """An image ``(H, W, 3)`` uint8 RGB as the networks take it, for several calls on the same image."""
        return PreparedImage(self._input(image))

    @torch.inference_mode()
    def disparity(self, image: NDArray[np.uint8] | PreparedImage) -> NDArray[np.float32]:
        """Unscaled 1/depth of an image ``(H, W, 3)`` uint8 RGB, float32 at the networks' own size.

        Raises:
            CheckpointError: the network's output is not finite.
        """
        disparity: NDArray[np.float32] = self._networks.depth(self._tensor(image))[0, 0].float().cpu().numpy()
        return self._finite(disparity, "depth")

    @torch.inference_mode()
    def poses(self, images: Sequence[NDArray[np.uint8] | PreparedImage]) -> NDArray[np.float64]:
        """Poses of a snippet's sources.

        Args:
            images: N + 1 frames ``(H, W, 3)`` uint8 RGB in time order, the target in the middle.

        Returns:
            ``T_source_target`` ``(N, 4, 4)``, target camera to source camera, unscaled; row k belongs to
            the k-th source in time order.

        Raises:
            ValueError: another number of images than the networks were trained for.
            CheckpointError: the network's output is not finite.
        """
        if len(images) != self.sources + 1:
            raise ValueError(f"a snippet must have {self.sources + 1} images; got {len(images)}")
        middle = self.sources // 2
        inputs = [self._pose_input(image) for image in images]
        target = inputs.pop(middle)
        vectors = self._networks.pose(target, inputs)[0].double()
        T_source_target: NDArray[np.float64] = pose_vector_to_matrix(vectors).cpu().numpy()
        return self._finite(T_source_target, "pose")

    def _finite(self, output: NDArray[F], kind: str) -> NDArray[F]:
        """The output of a network, refused where it is not finite: float16 weights may overflow in a forward pass."""
        if not np.isfinite(output).all():
            raise CheckpointError(
                f"the {kind} network of {self.origin} gives NaN or infinite values: its training diverged; use other "
                "weights"
            )
        return output

    def _input(self, image: NDArray[np.uint8]) -> Tensor:
        """An image at the networks' size, in [-1, 1], ``(1, 3, H, W)``."""
        require_image(image)
        resized = resize_image(image, self.record.network.height, self.record.network.width)
        tensor = torch.from_numpy(resized.astype(np.float32)).to(self.device)
        return tensor.permute(2, 0, 1)[None].contiguous() / 127.5 - 1

    def _pose_input(self, image: NDArray[np.uint8] | PreparedImage) -> Tensor:
        """The image, or its features where the pose network encodes each image by itself."""
        features = self._networks.features
        if features is None:
            return self._tensor(image)
        prepared = image if isinstance(image, PreparedImage) else self.prepare(image)
        if prepared.features is None:
            prepared.features = features(prepared.tensor)
        return prepared.features

    def _tensor(self, image: NDArray[np.uint8] | PreparedImage) -> Tensor:
        return image.tensor if isinstance(image, PreparedImage) else self._input(image)


class _Features(nn.Module):
    """What a pose network sees of one image."""

    def __init__(self, network: Lite0PoseNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        """``(1, 3, h, w)`` to ``(1, C, h / 16, w / 16)``."""
        return self.network.features(image)


class _Motion(nn.Module):
    """Pose vectors ``(1, N, 6)`` from the features of a target and of its sources."""

    def __init__(self, network: Lite0PoseNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, target: Tensor, sources: list[Tensor]) -> Tensor:
        """Translation (unscaled) and XYZ Euler angles of each source."""
        vectors = self.network.motion(target, sources)
        assert isinstance(vectors, Tensor)  # a list in training alone
        return vectors


def require_image(image: object) -> None:
    """Refuse what is no image ``(H, W, 3)`` uint8.

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


def depth_at(disparity: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """Depth ``(height, width)`` from disparity ``(h, w)`` at the networks' size, both unscaled."""
    if disparity.shape != (height, width):
        disparity = np.asarray(cv2.resize(disparity, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    return np.asarray(1 / disparity, dtype=np.float32)


def colour_disparity(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """A picture ``(H, W, 3)`` RGB of 1/depth: near is bright, the nearest 2 % saturate."""
    disparity = 1 / depth
    low, high = np.percentile(disparity, [1, 98])
    shade = np.clip((disparity - low) / max(high - low, 1e-9) * 255, 0, 255).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(shade, cv2.COLORMAP_MAGMA)[..., ::-1])


def save_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an RGB image, whole or not at all."""
    if path.suffix.lower() not in (".png", ".jpg"):
        raise DataError(f"cannot write {path}: images are .png or .jpg")
    require_image(image)
    _, encoded = cv2.imencode(path.suffix, np.ascontiguousarray(image[..., ::-1]))
    write_atomically(path, lambda temporary: temporary.write_bytes(encoded.tobytes()))


def save_depth(path: Path, depth: NDArray[np.float32]) -> None:
    """Write a depth map as ``.npy``, whole or not at all."""

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.save(file, depth)

    write_atomically(path, write)


def is_prediction(depth_file: Path) -> bool:
    """Whether a ``.npy`` file and the ``.png`` beside it were predicted: the picture must be that of the array."""
    picture_file = depth_file.with_suffix(".png")
    if not (depth_file.is_file() and picture_file.is_file()):
        return False
    try:
        depth, picture = np.load(depth_file, mmap_mode="r", allow_pickle=False), read_image(picture_file)
    except (OSError, ValueError, EOFError, DataError):
        return False
    if not isinstance(depth, np.ndarray) or depth.dtype != np.float32 or depth.shape != picture.shape[:2]:
        return False
    with np.errstate(all="ignore"):
        return np.array_equal(colour_disparity(depth), picture)
