"""The network that fuses learned depth with measurements of neighbouring images, and its training."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import partial
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn import functional

from erfsfm.common.errors import TrainingError
from erfsfm.common.files import write_atomically
from erfsfm.common.processes import processes
from erfsfm.common.progress import Progress
from erfsfm.data.discovery import discover
from erfsfm.inference import DepthPosePredictor, has_bfloat16
from erfsfm.mvs.fusion import CHANGE, CHANNELS, FILE, FULL_SIZE, STEP, DepthFusion
from erfsfm.networks.torch_network import exported
from erfsfm.training.fusion_samples import FusionSamples, Sample

WIDTHS = (16, 32, 64, 96)
LEVELS = len(WIDTHS) - 1  # halvings inside the network
_TRUST = 3.0  # of a fresh network in the measurement: its logit
_UNSURE = -3.0  # logarithm of its sigma
_LARGEST_CHANGE = 2.0
RECORD = "fusion.json"
_BATCH = 8
_LEARNING_RATE, _LEAST_RATE = 2e-3, 0.01
_LATER_RATE = 5e-4  # of a network that was trained before
_WARM_UP = 100
_WEIGHT_DECAY = 1e-3
_HUBER = 0.02  # of log depth
_RELATIVE = 0.5  # weights of losses beside the error of log depth
_LIKELIHOOD = 0.1
_EDGES = 0.3
_SKY = 0.2
_EDGE_STEPS = (1, 2, 4)  # pixels
_LARGEST_ERROR = 1.5  # of log depth, for the relative error
_CHUNK = 100  # samples of one task and one seed
_VALIDATION_SEED = 10**6
_COVERAGE = 0.9  # the sigma is scaled so that this share of the errors is within as many of it
_SIGMAS = 1.645


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

    def begin_with(self, path: Path) -> None:
        """Take the weights of a network that was exported, whose norms are parts of its convolutions, and stay so.

        Args:
            path: of its ``fusion.onnx``.
        """
        graph = onnx.load(path).graph
        values = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
        convolutions = iter([node.input for node in graph.node if node.op_type == "Conv"])
        bias = torch.empty(0)
        with torch.no_grad():
            for part in (*self.down, *chain(*zip(self.narrow, self.up, strict=True)), self.head):
                for layer in part.modules():
                    if isinstance(layer, nn.Conv2d):
                        _, weights, biases = next(convolutions)
                        layer.weight.copy_(torch.tensor(values[weights]))
                        bias = torch.tensor(values[biases])
                    elif isinstance(layer, nn.BatchNorm2d) and layer.running_var is not None:
                        layer.running_var.fill_(1 - layer.eps)
                    if isinstance(layer, nn.Conv2d | nn.BatchNorm2d) and layer.bias is not None:
                        layer.bias.copy_(bias)
        self.eval()

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


def train_fusion(
    datasets: Sequence[Path],
    validation: Sequence[Path],
    output: Path,
    networks: tuple[str, str | None],
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
        networks: weights of the one that guesses depth; and the one to begin with, as `DepthFusion` names it, None for
            a fresh one.
        samples: to draw; a thousand takes 0.7 GB of memory.
        steps: of optimisation, with batches of eight.
        seed: of everything drawn.
        command: for the record.
        progress: is told.

    Raises:
        CheckpointError: there is no such network to begin with.
        TrainingError: data without depth or poses, or a file of another program in the way.
    """
    assert STEP == 2**LEVELS, "evidence is padded for another network"
    torch.manual_seed(seed)
    if (output / FILE).exists() and not (output / RECORD).exists():
        raise TrainingError(
            f"{output / FILE} is not of train-fusion and would be replaced: choose another --output"
        )
    output.mkdir(parents=True, exist_ok=True)
    weights, start = networks
    net = FusionNet(CHANNELS, 4 * CHANGE)
    if start is not None:
        net.begin_with(DepthFusion(start).path)
    data = _drawn(datasets, weights, samples, seed, progress)
    held_out = _drawn(validation, weights, max(samples // 20, _CHUNK), _VALIDATION_SEED, progress)
    net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
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
        "start": start,
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
    # a network that was trained before is not in training mode: its norms stay
    most = _LEARNING_RATE if net.training else _LATER_RATE
    optimiser = torch.optim.AdamW(net.parameters(), most, weight_decay=_WEIGHT_DECAY)

    def rate(step: int) -> float:
        return min(1, (step + 1) / _WARM_UP) * max(
            _LEAST_RATE, (1 + math.cos(math.pi * step / max(steps, 1))) / 2
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
        for parts, found in zip(errors.values(), (torch.zeros_like(change), measured, change)):
            parts.append((torch.exp((wanted - found)[is_known]) - 1).abs())
        ratios.append(((wanted - change).abs() * torch.exp(-log_sigma))[is_known])
    every = torch.cat(ratios)[::7]
    factor = torch.quantile(every[: 10**7], _COVERAGE) / _SIGMAS
    assert net.head.bias is not None
    net.head.bias[8:] += torch.log(factor)
    metrics: dict[str, float] = {}
    for name, parts in errors.items():
        each = torch.cat(parts)
        metrics |= {f"{name}_mean": float(each.mean()), f"{name}_median": float(each.median())}
    return metrics
