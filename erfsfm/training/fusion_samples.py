"""Samples for the network that fuses depth: frames of simulated drives as a run sees keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from erfsfm.common.errors import TrainingError
from erfsfm.data.augmentation import weathered
from erfsfm.data.recordings import Recording
from erfsfm.data.snippets import FARTHEST_M
from erfsfm.inference import DepthPosePredictor, depth_at
from erfsfm.mvs.fusion import evidence
from erfsfm.mvs.refine import measure
from erfsfm.mvs.views import BASELINES, Appearance, Array, neighbours

WIDTH = 416
CROP = (64, 144)  # of the evidence
_BASELINES = (*BASELINES, -BASELINES[0])  # as a run has them mostly
_BASELINE_SPREAD = 0.4
_LEFT_OUT = 0.1  # chance of each neighbour
_WEATHER = 0.4
_SCALE_SPREAD = 0.04
_TURN_ERROR_DEG = 0.02
_DIRECTION_ERROR_DEG = 0.35  # of a motion, as runs have it on KITTI 00, 02 and 05
_LENGTH_ERROR = 0.01
_LEAST_KNOWN = 0.3  # of the pixels of a frame
_MOST_TRIES = 200  # frames until one has depth and neighbours

_WANTED = (
    f"the fusion network is trained on simulated drives of at least {WIDTH}x{2 * CROP[0]} in shape; make some by "
    "erfsfm-slam simulate W --depth"
)


class Sample(NamedTuple):
    """``evidence`` ``(CHANNELS, h, w)``, and the wanted change of log inverse depth ``(2h, 2w)``.

    Where the depth is not ``is_known`` ``(2h, 2w)`` there is sky, and the change to the least depth of it is wanted.
    """

    evidence: NDArray[np.float16]
    wanted: NDArray[np.float16]
    is_known: NDArray[np.bool_]


class FusionSamples:
    """Random frames of simulated drives, seen as a run sees its keyframes: poses, images and unit have errors.

    Args:
        recordings: simulated drives.
        networks: that guess depth.
        seed: of all random draws.

    Raises:
        TrainingError: no drive has depth maps and poses, or one has too flat images.
    """

    def __init__(
        self, recordings: Sequence[Recording], networks: DepthPosePredictor, seed: int
    ) -> None:
        self._drives: list[tuple[Recording, NDArray[np.float64]]] = []
        for recording in recordings:
            poses = None if recording.depth is None else recording.true_poses()
            if poses is not None:
                self._drives.append((recording, poses))
                if _height(recording) < 2 * CROP[0]:
                    raise TrainingError(f"{recording.name} has flatter images: {_WANTED}")
        if not self._drives:
            raise TrainingError(f"no drive has depth maps and poses: {_WANTED}")
        self._networks, self._rng = networks, np.random.default_rng(seed)

    def draw(self) -> Sample:
        """Of a random crop of a random frame.

        Raises:
            TrainingError: no frame has depth and neighbours.
        """
        for _ in range(_MOST_TRIES):
            recording, T_world_camera = self._drives[int(self._rng.integers(len(self._drives)))]
            index = int(self._rng.integers(len(recording)))
            truth = recording.true_depth(index)
            if truth is not None and (truth > 0).mean() > _LEAST_KNOWN:
                drawn = self._sample(recording, T_world_camera, index, truth)
                if drawn is not None:
                    return drawn
        raise TrainingError(f"no frame has dense depth and others at a useful distance: {_WANTED}")

    def _sample(
        self, recording: Recording, T_world_camera: NDArray[np.float64], index: int, truth: Array
    ) -> Sample | None:
        rng = self._rng
        height = _height(recording)
        truth = np.asarray(
            cv2.resize(truth, (WIDTH, height), interpolation=cv2.INTER_NEAREST_EXACT)
        )
        baselines = np.multiply(
            _BASELINES, np.exp(rng.normal(0, _BASELINE_SPREAD, len(_BASELINES)))
        )
        chosen = neighbours(T_world_camera, index, baselines * np.median(truth[truth > 0]))
        chosen = [n for n in chosen if rng.random() > _LEFT_OUT]
        if not chosen:
            return None
        images = [recording.image(n, height, WIDTH) for n in (index, *chosen)]
        guess = self._guess(images[0], truth)
        if rng.random() < _WEATHER:
            images = weathered(images, rng)
        target, *others = (Appearance.of(_recorded(image, rng)) for image in images)
        T_neighbour_target = np.linalg.inv(T_world_camera[chosen]) @ T_world_camera[index]
        for T in T_neighbour_target:
            turn, aside = (
                cv2.Rodrigues(rng.normal(0, np.deg2rad(error), 3))[0]
                for error in (_TURN_ERROR_DEG, _DIRECTION_ERROR_DEG)
            )
            T[:3, :3] = T[:3, :3] @ turn
            T[:3, 3] = aside @ T[:3, 3] * (1 + rng.normal(0, _LENGTH_ERROR))
        K = recording.camera.resized(WIDTH, height).K.astype(np.float64)
        channels = evidence(measure(target, guess, others, K, T_neighbour_target))
        is_known = truth > 0
        wanted = np.log(guess / np.where(is_known, truth, FARTHEST_M))
        h, w = CROP
        top = int(rng.integers(channels.shape[1] - h + 1))
        left = int(rng.integers(channels.shape[2] - w + 1))
        at = slice(2 * top, 2 * (top + h)), slice(2 * left, 2 * (left + w))
        part = channels[:, top : top + h, left : left + w]
        return Sample(part.astype(np.float16), wanted[at].astype(np.float16), is_known[at])

    def _guess(self, image: NDArray[np.uint8], truth: Array) -> Array:
        """Learned depth with an error of its unit; often bent or blurred, as that of networks on unknown streets."""
        rng = self._rng
        height, width = truth.shape
        depth = depth_at(self._networks.disparity(image), height, width)  # as a run has it
        known = truth > 0
        depth = depth * np.float32(
            np.median(truth[known] / depth[known]) * np.exp(rng.normal(0, _SCALE_SPREAD))
        )
        if rng.random() < 0.6:
            bend = rng.normal(0, rng.uniform(0.02, 0.2), (rng.integers(2, 6), rng.integers(3, 10)))
            depth = depth * np.exp(
                cv2.resize(bend.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
            )
        if rng.random() < 0.4:
            depth = 1 / cv2.GaussianBlur(1 / depth, (0, 0), rng.uniform(1, 4))
        return np.asarray(depth, np.float32)


def _height(recording: Recording) -> int:
    """Of its images at ``WIDTH``."""
    return round(recording.camera.height * WIDTH / recording.camera.width)


def _recorded(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Grey, with the noise and the compression of a camera."""
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.float32)
    noisy = np.clip(grey + rng.normal(0, rng.uniform(0, 5), grey.shape), 0, 255).astype(np.uint8)
    if rng.random() < 0.5:
        return noisy
    packed = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(50, 95))])[1]
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8)
