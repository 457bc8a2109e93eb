"""The network that fuses learned depth with the measurements of neighbouring images, its samples and its training."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from erfsfm.common.errors import TrainingError
from erfsfm.common.files import write_atomically
from erfsfm.common.processes import processes
from erfsfm.common.progress import Progress
from erfsfm.data.augmentation import weathered
from erfsfm.data.discovery import discover
from erfsfm.data.recordings import Recording
from erfsfm.data.snippets import FARTHEST_M
from erfsfm.inference import DepthPosePredictor, depth_at, has_bfloat16
from erfsfm.mvs.fusion import CHANGE, CHANNELS, FILE, FULL_SIZE, STEP, evidence
from erfsfm.mvs.refine import measure
from erfsfm.mvs.views import BASELINES, Appearance, Array, neighbours
from erfsfm.networks.torch_network import exported

RECORD = "fusion.json"
_BATCH = 8
_LEARNING_RATE, _LEAST_RATE = 2e-3, 0.01
_WARM_UP = 100
_WEIGHT_DECAY = 1e-3
_HUBER = 0.02  # of log depth
_RELATIVE, _LIKELIHOOD, _EDGES, _SKY = (
    0.5,
    0.1,
    0.3,
    0.2,
)  # weights of losses beside the error of log depth
_EDGE_STEPS = (1, 2, 4)  # pixels
_LARGEST_ERROR = 1.5  # of log depth, for the relative error
_CHUNK = 100  # samples of one task and one seed
_VALIDATION_SEED = 10**6
_COVERAGE, _SIGMAS = (
    0.9,
    1.645,
)  # the sigma is scaled so that this share of the errors is within as many of it


def train_fusion(
    datasets: Sequence[Path],
    validation: Sequence[Path],
    output: Path,
    weights: str,
    samples: int,
    steps: int,
    seed: int,
    command: str,
    progress: Progress,
) -> dict[str, float]:
    """Train on simulated worlds, write ``fusion.onnx`` and a record; returns the errors on the validation's worlds.

    Args:
        datasets: roots with depth maps and poses.
        validation: such roots, not trained on, which also fit the sigma.
        output: receives the files.
        weights: of the network that guesses depth.
        samples: to draw; a thousand takes 0.7 GB of memory.
        steps: of optimisation, with batches of eight.
        seed: of everything drawn.
        command: for the record.
        progress: is told.

    Raises:
        TrainingError: data without depth or poses, or a file of another program in the way.
    """
    assert STEP == 2**LEVELS, "evidence is padded for another network"
    torch.manual_seed(seed)
    if (output / FILE).exists() and not (output / RECORD).exists():
        raise TrainingError(
            f"{output / FILE} is not of train-fusion and would be replaced: choose another --output"
        )
    output.mkdir(parents=True, exist_ok=True)
    data = _drawn(datasets, weights, samples, seed, progress)
    held_out = _drawn(validation, weights, max(samples // 20, _CHUNK), _VALIDATION_SEED, progress)
    net = FusionNet(CHANNELS, 4 * CHANGE).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    _optimise(net, data, steps, seed, progress)
    net.eval()
    metrics = _fit_sigma(net, held_out)
    graph = exported(
        net, [torch.zeros(1, CHANNELS, STEP, STEP)], ["evidence"], ["change", "log_sigma"], (2, 3)
    )
    write_atomically(output / FILE, graph)
    record = {
        "command": command,
        "weights": weights,
        "samples": samples,
        "steps": steps,
        "seed": seed,
        **metrics,
    }
    write_atomically(output / RECORD, json.dumps(record, indent=2) + "\n")
    return metrics


def _drawn(
    roots: Sequence[Path], weights: str, count: int, seed: int, progress: Progress
) -> list[Sample]:
    """Samples of worlds, by as many processes as there are cores; the same for any number of them."""
    chunks = [seed * 10**4 + n for n in range(math.ceil(count / _CHUNK))]
    drawn: list[Sample] = []
    with processes("draws evidence") as pool:
        for part in pool.map(partial(_chunk, tuple(roots), weights), chunks):
            drawn += part
            progress("evidence", min(len(drawn), count), count)
    return drawn[:count]


def _chunk(roots: Sequence[Path], weights: str, seed: int) -> list[Sample]:
    recordings = [recording for root in roots for recording in discover(root)]
    source = FusionSamples(
        recordings, DepthPosePredictor.from_weights(weights, runtime="onnx"), seed
    )
    return [source.draw() for _ in range(_CHUNK)]


def _optimise(
    net: FusionNet, data: Sequence[Sample], steps: int, seed: int, progress: Progress
) -> None:
    rng = np.random.default_rng(seed)
    optimiser = torch.optim.AdamW(net.parameters(), _LEARNING_RATE, weight_decay=_WEIGHT_DECAY)

    def rate(step: int) -> float:
        return min(1, (step + 1) / _WARM_UP) * max(
            _LEAST_RATE, (1 + math.cos(math.pi * step / steps)) / 2
        )

    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, rate)
    order: list[int] = []
    in_bfloat16 = has_bfloat16()
    for step in range(steps):
        if len(order) < _BATCH:
            order = rng.permutation(len(data)).tolist()
        evidence, wanted, is_known = _batch(
            [data[order.pop()] for _ in range(min(_BATCH, len(order)))]
        )
        if rng.random() < 0.5:
            evidence, wanted, is_known = _mirrored(evidence), wanted.flip(-1), is_known.flip(-1)
        with torch.autocast("cpu", torch.bfloat16, enabled=in_bfloat16):
            change, log_sigma = net(evidence)
        loss = fusion_loss(change, log_sigma, wanted, is_known)
        if not torch.isfinite(loss):
            raise TrainingError(
                f"the loss is not finite at step {step}: begin again with another --seed"
            )
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        progress(f"training, loss {loss.item():.3f}", step + 1, steps)


def fusion_loss(change: Tensor, log_sigma: Tensor, wanted: Tensor, is_known: Tensor) -> Tensor:
    """Huber's error of log depth, its relative error, edges, the likelihood of the sigma, and sky that is too near.

    Args:
        change: of log inverse depth ``(B, H, W)``.
        log_sigma: of it ``(B, H, W)``.
        wanted: the change to the true depth, in the sky to the least one ``(B, H, W)``.
        is_known: where the true depth is known ``(B, H, W)``.
    """
    known = is_known.float()
    count = known.sum().clamp(min=1)
    error = (wanted - change) * known  # of log depth
    huber = functional.smooth_l1_loss(error, torch.zeros_like(error), reduction="sum", beta=_HUBER)
    relative = (torch.exp(error.clamp(-2 * _LARGEST_ERROR, _LARGEST_ERROR)) - 1).abs().sum()
    log_sigma = log_sigma.clamp(-5, _LARGEST_ERROR)
    likelihood = ((error.detach().abs() * torch.exp(-log_sigma) + log_sigma) * known).sum()
    edges = error.new_zeros(())
    for step in _EDGE_STEPS:
        along = (
            (error[:, :, step:] - error[:, :, :-step]).abs()
            * known[:, :, step:]
            * known[:, :, :-step]
        )
        across = (error[:, step:] - error[:, :-step]).abs() * known[:, step:] * known[:, :-step]
        edges = edges + along.mean() + across.mean()
    sky = ((change - wanted).clamp(min=0) * (1 - known)).mean()
    return (
        (huber + _RELATIVE * relative + _LIKELIHOOD * likelihood) / count
        + _EDGES * edges
        + _SKY * sky
    )


def _batch(samples: Sequence[Sample]) -> tuple[Tensor, Tensor, Tensor]:
    evidence, wanted, is_known = (
        torch.from_numpy(np.stack(part)) for part in zip(*samples, strict=True)
    )
    return evidence.float().contiguous(memory_format=torch.channels_last), wanted.float(), is_known


def _mirrored(evidence: Tensor) -> Tensor:
    """Left and right exchanged, also in the blocks of four channels."""
    count, _, h, w = evidence.shape
    blocks = 4 * FULL_SIZE
    full = evidence[:, :blocks].reshape(count, -1, 2, 2, h, w).flip(3).reshape(count, blocks, h, w)
    return (
        torch.cat([full, evidence[:, blocks:]], 1)
        .flip(-1)
        .contiguous(memory_format=torch.channels_last)
    )


@torch.inference_mode()
def _fit_sigma(net: FusionNet, data: Sequence[Sample]) -> dict[str, float]:
    """Scale the sigma to the errors; returns mean and median relative errors of guess, measurement and network."""
    errors: dict[str, list[Tensor]] = {"guess": [], "measured": [], "fused": []}
    ratios = []
    for first in range(0, len(data), _BATCH):
        evidence, wanted, is_known = _batch(data[first : first + _BATCH])
        change, log_sigma = net(evidence)
        measured = functional.pixel_shuffle(evidence[:, 4 * CHANGE : 4 * CHANGE + 4], 2)[:, 0]
        for name, found in (
            ("guess", torch.zeros_like(change)),
            ("measured", measured),
            ("fused", change),
        ):
            errors[name].append((torch.exp((wanted - found)[is_known]) - 1).abs())
        ratios.append(((wanted - change).abs() * torch.exp(-log_sigma))[is_known])
    every = torch.cat(ratios)[::7]
    factor = torch.quantile(every[: 10**7], _COVERAGE) / _SIGMAS
    assert net.head.bias is not None
    net.head.bias[8:] += torch.log(factor)
    all_errors = {name: torch.cat(parts) for name, parts in errors.items()}
    return {f"{name}_mean": float(e.mean()) for name, e in all_errors.items()} | {
        f"{name}_median": float(e.median()) for name, e in all_errors.items()
    }


WIDTHS = (16, 32, 64, 96)
LEVELS = len(WIDTHS) - 1  # halvings inside the network
_TRUST = 3.0  # of a fresh network in the measurement: its logit
_UNSURE = -3.0  # logarithm of its sigma
_LARGEST_CHANGE = 2.0


class FusionNet(nn.Module):
    """Evidence ``(B, channels, h, w)`` to the change of log inverse depth and the log of its sigma, ``(B, 2h, 2w)``.

    The change is a mean of the measured one and one of its own, so a trusted measurement keeps its precision. Height
    and width are multiples of ``2 ** LEVELS``.

    Args:
        channels: of the evidence.
        measured: the first of the four channels with the measured change.
    """

    def __init__(self, channels: int, measured: int) -> None:
        super().__init__()
        self._measured = measured
        self.down = nn.ModuleList(
            nn.Sequential(*_layer(a, b), *_layer(b, b)) for a, b in pairwise((channels, *WIDTHS))
        )
        self.narrow = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in pairwise(WIDTHS[::-1]))
        self.up = nn.ModuleList(nn.Sequential(*_layer(width, width)) for width in WIDTHS[-2::-1])
        self.head = nn.Conv2d(WIDTHS[0], 12, 3, padding=1)
        nn.init.zeros_(self.head.weight)
        assert self.head.bias is not None
        with torch.no_grad():
            self.head.bias.copy_(torch.tensor([_TRUST, 0.0, _UNSURE]).repeat_interleave(4))

    def forward(self, evidence: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        kept = [self.down[0](evidence)]
        for block in list(self.down)[1:]:
            kept.append(block(functional.max_pool2d(kept[-1], 2)))
        decided = kept.pop()
        for narrow, block in zip(self.narrow, self.up, strict=True):
            larger = functional.interpolate(
                narrow(decided), scale_factor=2, mode="bilinear", align_corners=False
            )
            decided = block(larger + kept.pop())
        trust, own, log_sigma = self.head(decided).float().split(4, 1)
        trust = torch.sigmoid(trust)
        measured = evidence[:, self._measured : self._measured + 4]
        change = trust * measured + (1 - trust) * _LARGEST_CHANGE * torch.tanh(own)
        return functional.pixel_shuffle(change, 2)[:, 0], functional.pixel_shuffle(log_sigma, 2)[
            :, 0
        ]


def _layer(inputs: int, outputs: int) -> list[nn.Module]:
    return [
        nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(),
    ]


WIDTH = 416
CROP = (64, 144)  # of the evidence
_BASELINES = (*BASELINES, -BASELINES[0])  # as a run has them mostly
_BASELINE_SPREAD = 0.4
_LEFT_OUT = 0.1  # chance of each neighbour
_WEATHER = 0.4
_SCALE_SPREAD = 0.04
_TURN_ERROR_DEG = 0.02
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
    """Random frames of simulated drives, seen as a run sees its keyframes: poses, images and unit have errors."""

    def __init__(
        self, recordings: Sequence[Recording], networks: DepthPosePredictor, seed: int
    ) -> None:
        posed = [
            (r, poses)
            for r in recordings
            if r.depth is not None and (poses := r.true_poses()) is not None
        ]
        if not posed:
            raise TrainingError(f"no drive has depth maps and poses: {_WANTED}")
        flat = [r for r, _ in posed if _height(r) < 2 * CROP[0]]
        if flat:
            raise TrainingError(f"{flat[0].name} has flatter images: {_WANTED}")
        self._recordings, self._poses = zip(*posed, strict=True)
        self._networks, self._rng = networks, np.random.default_rng(seed)

    def draw(self) -> Sample:
        """Of a random crop of a random frame.

        Raises:
            TrainingError: no frame has depth and neighbours.
        """
        for _ in range(_MOST_TRIES):
            which = int(self._rng.integers(len(self._recordings)))
            index = int(self._rng.integers(len(self._recordings[which])))
            truth = self._recordings[which].true_depth(index)
            if truth is not None and (truth > 0).mean() > _LEAST_KNOWN:
                drawn = self._sample(self._recordings[which], self._poses[which], index, truth)
                if drawn is not None:
                    return drawn
        raise TrainingError(f"no frame has dense depth and others at a useful distance: {_WANTED}")

    def _sample(
        self, recording: Recording, T_world_camera: NDArray[np.float64], index: int, truth: Array
    ) -> Sample | None:
        rng = self._rng
        camera = recording.camera
        height = _height(recording)
        size = (WIDTH, height)
        truth = np.asarray(cv2.resize(truth, size, interpolation=cv2.INTER_NEAREST_EXACT))
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
            turn, _ = cv2.Rodrigues(rng.normal(0, np.deg2rad(_TURN_ERROR_DEG), 3))
            T[:3, :3] = T[:3, :3] @ turn
            T[:3, 3] *= 1 + rng.normal(0, _LENGTH_ERROR)
        K = camera.resized(WIDTH, height).K.astype(np.float64)
        channels = evidence(measure(target, guess, others, K, T_neighbour_target))
        is_known = truth > 0
        wanted, (h, w) = np.log(guess / np.where(is_known, truth, FARTHEST_M)), CROP
        top, left = (
            int(rng.integers(have - need + 1)) for have, need in zip(channels.shape[1:], CROP)
        )
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
