"""The self-supervised objective of one batch of snippets (Zhou et al. 2017; Godard et al. 2019; Bian et al. 2019)."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from erfsfm.config import ExperimentConfig, LossConfig
from erfsfm.data.window import HEIGHTS
from erfsfm.geometry import pose_vector_to_matrix, project_into_source, sample, scale_intrinsics
from erfsfm.losses import (
    Bounds,
    disagreement,
    edge_aware_smoothness,
    enlarged,
    photometric_error,
    rotation_disagreement,
    second_order_smoothness,
    step_disagreement,
    translation_disagreement,
)

_SEEN = 0.99  # of a pixel of a source that shows the world


@dataclass(frozen=True)
class SnippetBatch:
    """``target`` ``(B, 3, H, W)`` and ``sources`` ``(S, N, 3, H, W)`` in [0, 1], time order; ``K`` ``(B, 3, 3)``.

    The sources are of the last S targets; the others are single images with bounds of their depth. S may be 0.
    Labels of the teacher (`erfsfm.data.window`), where one is used: ``T_source_target``
    ``(S, N, 4, 4)`` in camera heights, NaN where nothing is known, and ``bounds`` of the B targets' inverse depth.
    With simulated weather: ``shown`` ``(S, N + 1, 3, H, W)``, all images in time order as the networks get them.
    ``fixed`` ``(S, 1, H, W)`` is true where a snippet shows what is fixed to its camera.
    """

    target: Tensor
    sources: Tensor
    K: Tensor
    T_source_target: Tensor | None = None
    bounds: Bounds | None = None
    shown: Tensor | None = None
    fixed: Tensor | None = None

    def seen(self) -> tuple[Tensor, list[Tensor]]:
        """Target and sources as the networks see them, in [-1, 1]."""
        if self.shown is None:
            return to_network_range(self.target), [
                to_network_range(source) for source in self.sources.unbind(dim=1)
            ]
        images = [to_network_range(image) for image in self.shown.unbind(dim=1)]
        target = images.pop(len(images) // 2)
        return torch.cat([to_network_range(self.target[: -len(target)]), target]), images

    def snippets(self) -> SnippetBatch:
        """Images and cameras of the targets that have sources."""
        first = len(self.target) - len(self.sources)
        target, K = self.target[first:], self.K[first:]
        return SnippetBatch(target, self.sources, K, fixed=self.fixed)


@dataclass(frozen=True)
class ObjectiveResult:
    """The loss, its terms, and the depth network's outputs: ``disparities`` finest first, each ``(B, 1, h, w)``."""

    total: Tensor
    terms: dict[str, Tensor]
    disparities: list[Tensor]


def to_network_range(image: Tensor) -> Tensor:
    """Colour in [0, 1] to the networks' [-1, 1]."""
    return image * 2 - 1


def evaluate_objective(
    depth_net: nn.Module, pose_net: nn.Module, batch: SnippetBatch, config: ExperimentConfig
) -> ObjectiveResult:
    """Predict depth and poses of a batch and evaluate the loss.

    The networks may run under autocast; geometry and losses keep the images' precision: a pixel
    coordinate needs more than the eight bits of a bfloat16.

    Args:
        depth_net: in training mode, where it gives a pyramid of disparities.
        pose_net: for as many sources as the batch has.
        batch: images and intrinsics.
        config: its ``loss``, ``network`` and ``teacher`` sections are used.
    """
    precise = batch.target.dtype
    target, sources = batch.seen()
    of_snippets = target[len(target) - len(batch.sources) :]
    disparities: list[Tensor] = []
    if needs_depth(config):
        if not depth_net.training:
            raise ValueError("the objective needs the depth network in training mode")
        disparities = [disparity.to(precise) for disparity in depth_net(target)]
    pose_vectors = target.new_zeros(len(of_snippets), len(sources), 6)
    if needs_poses(config):
        pose_vectors = pose_net(of_snippets, sources).to(precise)
    device = batch.target.device.type
    has_autocast = torch.amp.is_autocast_available(device)  # `meta` has none
    with torch.autocast(device, enabled=False) if has_autocast else nullcontext():
        return _evaluate(disparities, pose_vector_to_matrix(pose_vectors), batch, config)


def needs_depth(config: ExperimentConfig) -> bool:
    """Whether any term of the loss depends on the depth network."""
    loss, teacher = config.loss, config.teacher
    by_teacher = teacher.structure_weight + teacher.edge_weight
    weights = loss.photometric_weight + loss.smoothness_weight + by_teacher
    return config.training.networks != "pose" and weights > 0


def needs_poses(config: ExperimentConfig) -> bool:
    """Whether any term of the loss depends on the pose network; a teacher may give the motion that warps images."""
    teacher = config.teacher
    warps = config.loss.photometric_weight > 0 and not teacher.gives_motion
    by_teacher = teacher.rotation_weight + teacher.translation_weight > 0
    return warps or (by_teacher and config.training.networks != "depth")


def _evaluate(
    disparities: list[Tensor],
    T_source_target: Tensor,
    batch: SnippetBatch,
    config: ExperimentConfig,
) -> ObjectiveResult:
    """The loss of the networks' outputs, disparities ``(B, 1, h, w)`` and poses ``(S, N, 4, 4)``."""
    loss = config.loss
    T_warp = T_source_target
    if config.teacher.gives_motion and batch.T_source_target is not None:
        T_warp = batch.T_source_target.clone()
        T_warp[..., :3, 3] /= HEIGHTS
    photometric, smoothness = batch.target.new_zeros(()), batch.target.new_zeros(())
    snippets = batch.snippets()
    for level, disparity in enumerate(disparities if len(snippets.target) > 0 else ()):
        scale = Level.of(snippets, disparity[-len(snippets.target) :], config)
        smoothness = smoothness + scale.smoothness(loss) / 2**level
        if loss.photometric_weight > 0:
            photometric = photometric + scale.photometric(T_warp, loss)
    if config.network.fidelity == "paper":
        photometric = 2 * photometric  # the reference compares images in [-1, 1]
    terms = {"photometric": photometric, "smoothness": smoothness}
    total = loss.photometric_weight * photometric + loss.smoothness_weight * smoothness
    if batch.bounds is not None:
        size = (batch.bounds[0].shape[-2], batch.bounds[0].shape[-1])
        if disparities:
            levels = [enlarged(disparity, k, size) for k, disparity in enumerate(disparities)]
            errors = [disagreement(level, batch.bounds, math.log(HEIGHTS)) for level in levels]
            terms["structure"] = torch.stack(errors).mean()
            if config.teacher.edge_weight > 0:
                terms["edge"] = step_disagreement(disparities[0], batch.bounds)
        T_measured = batch.T_source_target
        if needs_poses(config) and T_measured is not None:
            R_wanted, t_wanted = T_measured[..., :3, :3], T_measured[..., :3, 3] / HEIGHTS
            terms["rotation"] = rotation_disagreement(T_source_target[..., :3, :3], R_wanted)
            terms["translation"] = translation_disagreement(T_source_target[..., :3, 3], t_wanted)
        for name, weight in config.teacher.weights.items():
            total = total + weight * terms.get(name, total.new_zeros(()))
    return ObjectiveResult(total, terms, disparities)


@dataclass(frozen=True)
class Level:
    """One level of the image pyramid with its disparity."""

    target: Tensor  # (B, 3, h, w)
    sources: Tensor  # (B, N, 3, h, w)
    K: Tensor
    disparity: Tensor  # (B, 1, h, w)
    # (B, 1, h, w), 0 where something fixed to the camera hides the world
    seen: Tensor | None = None

    @staticmethod
    def of(batch: SnippetBatch, disparity: Tensor, config: ExperimentConfig) -> Level:
        """Of a batch whose images are shrunk to the size of the disparity."""
        size = (disparity.shape[-2], disparity.shape[-1])
        full = (batch.target.shape[-2], batch.target.shape[-1])
        seen = (
            None
            if batch.fixed is None
            else 1.0 - F.adaptive_max_pool2d(batch.fixed.to(batch.target), size)
        )
        if size == full:
            return Level(batch.target, batch.sources, batch.K, disparity, seen)
        sources = F.interpolate(batch.sources.flatten(0, 1), size=size, mode="area")
        return Level(
            F.interpolate(batch.target, size=size, mode="area"),
            sources.reshape(*batch.sources.shape[:3], *size),
            scale_intrinsics(batch.K, size, full, config.network.fidelity),
            disparity,
            seen,
        )

    def errors(self, T_source_target: Tensor, ssim_weight: float) -> tuple[Tensor, Tensor]:
        """Photometric errors of all sources warped to the target, and where they are seen, ``(B, N, h, w)`` each."""
        count = self.sources.shape[1]
        depth = (1 / self.disparity).repeat_interleave(count, dim=0)  # (B*N, 1, h, w)
        K = self.K.repeat_interleave(count, dim=0)
        grid, valid = project_into_source(depth, T_source_target.flatten(0, 1), K)
        warped = sample(self.sources.flatten(0, 1), grid)
        error = photometric_error(self.target.repeat_interleave(count, dim=0), warped, ssim_weight)
        shape = (len(self.target), count, *error.shape[-2:])
        error, valid = error.reshape(shape), valid.reshape(shape)
        if self.seen is not None:
            source = sample(self.seen.repeat_interleave(count, dim=0), grid).reshape(shape)
            valid = valid & (self.seen > 0) & (source > _SEEN)
        return error, valid

    def photometric(self, T_source_target: Tensor, loss: LossConfig) -> Tensor:
        """Their mean over pixels, reduced over sources as the loss wants it."""
        error, valid = self.errors(T_source_target, loss.ssim_weight)
        if loss.reduction == "mean":
            # pixels without a source count as zero and sources are summed, as in the paper's code
            return (error * valid).sum(dim=1).mean()
        best = error.masked_fill(~valid, torch.inf).amin(dim=1)  # (B, h, w)
        middle = self.sources.shape[1] // 2
        with torch.no_grad():
            before, after = self.sources[:, middle - 1], self.sources[:, middle]
            unwarped = [
                photometric_error(self.target, image, loss.ssim_weight) for image in (before, after)
            ]
            still = torch.minimum(*unwarped)[:, 0]  # (B, h, w)
        counted = valid.any(dim=1) & (best.detach() < still)
        return best.masked_fill(~counted, 0).sum() / counted.sum().clamp(min=1)

    def smoothness(self, loss: LossConfig) -> Tensor:
        """Of depth, or of disparity."""
        if loss.smoothness == "depth-second-order":
            return second_order_smoothness(1 / self.disparity)
        return edge_aware_smoothness(self.disparity, self.target)
