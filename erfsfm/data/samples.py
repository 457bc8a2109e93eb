"""A training sample: the images of a snippet, augmented, as tensors, with what a teacher measured of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from erfsfm.config import ExperimentConfig
from erfsfm.data.augmentation import Maps, augment, rolled, weathered
from erfsfm.data.window import HEIGHTS, TeacherStructure
from erfsfm.geometry.camera import Camera

# An image does not show its focal length. Under a teacher lengths are those of a camera of this
# focal length, in image heights (KITTI's), so that cameras and random crops agree (Yin et al. 2023, Metric3D).
FOCAL_LENGTH = 1.9


def training_sample(
    images: list[NDArray[np.uint8]],
    camera: Camera,
    seen: TeacherStructure | None,
    config: ExperimentConfig,
    rng: np.random.Generator,
) -> dict[str, Tensor]:
    """Augment a snippet and make it a sample.

    Args:
        images: N + 1 in time order at the networks' size, ``(H, W, 3)`` each.
        camera: of these images.
        seen: what the teacher measured, if there is one.
        config: of the experiment.
        rng: of all random draws.

    Returns:
        Tensors ``target`` (3, H, W) and ``sources`` (N, 3, H, W) in uint8, and ``K`` (3, 3). With a teacher, also
        ``T_source_target`` (N, 4, 4), ``least`` and ``most`` (1, H, W) of `TeacherStructure`. With weather, also
        ``shown`` (N + 1, 3, H, W): the images in time order as the networks see them.
    """
    bounds = [] if seen is None else [seen.least.astype(np.float32), seen.most.astype(np.float32)]
    images, bounds, varied, mirrored = augment(images, bounds, camera, config.data, config.network.fidelity, rng)
    sample = as_tensors(images, varied.K)
    if seen is not None:
        mirror, nearer = np.diag([-1 if mirrored else 1, 1, 1, 1]).astype(np.float32), _nearer(varied, config)
        T_source_target = mirror @ seen.T_source_target @ mirror
        T_source_target[:, :3, 3] /= nearer
        sample["T_source_target"] = torch.from_numpy(T_source_target)
        sample |= _bounds(bounds, nearer)
    probability = config.data.weather
    if probability > 0:
        sample["shown"] = _stacked(weathered(images, rng) if rng.random() < probability else images)
    return sample


def single_image(
    image: NDArray[np.uint8],
    camera: Camera,
    bounds: Sequence[NDArray[np.floating]],
    config: ExperimentConfig,
    rng: np.random.Generator,
) -> dict[str, Tensor]:
    """Augment an image ``(H, W, 3)`` with bounds of its inverse depth and make it a sample without sources.

    Returns:
        Tensors ``target``, ``K``, ``least`` and ``most`` as in `training_sample`.
    """
    if rng.random() < config.data.weather:
        image = weathered([image], rng)[0]
    maps = [bound.astype(np.float32) for bound in bounds]
    if config.data.roll > 0:
        angle = np.deg2rad(rng.uniform(-config.data.roll, config.data.roll))
        image, maps = rolled(image, maps, camera, angle, (0, np.inf))
    images, maps, varied, _ = augment([image], maps, camera, config.data, config.network.fidelity, rng)
    sample = {"target": _stacked(images)[0], "K": torch.from_numpy(varied.K)}
    return sample | _bounds(maps, _nearer(varied, config))


def depth_alone(inverse_depth: NDArray[np.float32], camera: Camera, config: ExperimentConfig) -> TeacherStructure:
    """A structure of unknown motion with the inverse depth ``(H, W)`` that a network gives for an image."""
    bound = (inverse_depth / np.float32(HEIGHTS * _nearer(camera, config))).astype(np.float16)
    return TeacherStructure(np.full((config.network.sources, 4, 4), np.nan, np.float32), bound, bound)


def _nearer(camera: Camera, config: ExperimentConfig) -> float:
    """How much nearer everything looks to this camera than to one of `FOCAL_LENGTH`."""
    return float(camera.fy / config.network.height / FOCAL_LENGTH)


def _bounds(bounds: Maps, nearer: float) -> dict[str, Tensor]:
    """Least and most inverse depth ``(1, H, W)`` as the reference camera would see them."""
    least, most = (torch.from_numpy(values * np.float32(nearer))[None] for values in bounds)
    return {"least": least, "most": most}


def as_tensors(images: list[NDArray[np.uint8]], K: NDArray[np.float32]) -> dict[str, Tensor]:
    """Images in time order to ``target`` (the middle one), ``sources`` and ``K``; colour as uint8."""
    middle = len(images) // 2
    stacked = _stacked(images)
    sources = torch.cat([stacked[:middle], stacked[middle + 1 :]])
    return {"target": stacked[middle], "sources": sources, "K": torch.from_numpy(K)}


def _stacked(images: list[NDArray[np.uint8]]) -> Tensor:
    """Colour as uint8, ``(N + 1, 3, H, W)``."""
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)


def in_unit_range(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of a batch with colour in [0, 1]; samples hold it as uint8, a quarter of the bytes to hand over."""
    return {name: each.float() / 255 if each.dtype == torch.uint8 else each for name, each in batch.items()}
