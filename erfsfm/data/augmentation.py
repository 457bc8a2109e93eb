"""A training sample: a snippet under random flip, scale-crop, colour and weather, with its camera and labels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from erfsfm.config import DataConfig, ExperimentConfig, Fidelity
from erfsfm.data.window import HEIGHTS, TeacherStructure
from erfsfm.geometry import Camera

Images = list[NDArray[np.uint8]]
Maps = list[NDArray[np.float32]]
Pictures = list[NDArray[np.float32]]  # colour in [0, 1]

_EACH = 0.6  # chance of each weather
_BLUR_SAMPLES = 6  # images averaged into a blurred one

# An image does not show its focal length. Under a teacher lengths are those of a camera of this
# focal length, in image heights (KITTI's), so that cameras and random crops agree (Yin et al. 2023, Metric3D).
FOCAL_LENGTH = 1.9


def augment(
    images: Images,
    maps: Maps,
    camera: Camera,
    config: DataConfig,
    fidelity: Fidelity,
    rng: np.random.Generator,
) -> tuple[Images, Maps, Camera, bool]:
    """Flip, scale-crop and recolour a snippet, all frames in the same way.

    Args:
        images: ``(H, W, 3)`` uint8 each.
        maps: ``(H, W)`` each, per-pixel data: moved by nearest neighbour, never recoloured.
        camera: of these images.
        config: probabilities and largest changes.
        fidelity: ``paper`` mirrors and scales the principal point as the reference does.
        rng: of all random draws.

    Returns:
        Images and maps of the same size, their camera, and whether they are mirrored.
    """
    mirrored = bool(rng.random() < config.flip)
    if mirrored:
        images = [np.ascontiguousarray(image[:, ::-1]) for image in images]
        maps = [np.ascontiguousarray(values[:, ::-1]) for values in maps]
        camera = camera.flipped(fidelity)
    if config.zoom > 1:
        images, maps, camera = _scale_crop(images, maps, camera, config.zoom, fidelity, rng)
    if config.colour_jitter > 0:
        images = _recolour(images, config.colour_jitter, rng)
    return images, maps, camera, mirrored


def rolled(
    image: NDArray[np.uint8], maps: Maps, camera: Camera, angle: float, unknown: Sequence[float]
) -> tuple[NDArray[np.uint8], Maps]:
    """The image ``(H, W, 3)`` and maps ``(H, W)`` of a camera turned about its optical axis by an angle in radians.

    Z-depth stays as it is. Each map has its ``unknown`` value beyond the image's edges, where the image is mirrored.
    """
    K = camera.K.astype(np.float64)
    cos, sin = np.cos(angle), np.sin(angle)
    move = (K @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ np.linalg.inv(K))[:2]
    size = (camera.width, camera.height)
    turned = cv2.warpAffine(
        image, move, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    nearest = []
    for values, value in zip(maps, unknown, strict=True):
        moved = cv2.warpAffine(
            values,
            move,
            size,
            flags=cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=value,
        )
        nearest.append(moved)
    return np.asarray(turned, np.uint8), nearest


def _scale_crop(
    images: Images,
    maps: Maps,
    camera: Camera,
    zoom: float,
    fidelity: Fidelity,
    rng: np.random.Generator,
) -> tuple[Images, Maps, Camera]:
    """Enlarge each axis by its own factor and crop back at a random place."""
    width, height = camera.width, camera.height
    zoom_x, zoom_y = rng.uniform(1, zoom, 2)
    size = int(width * zoom_x), int(height * zoom_y)
    enlarged = camera.resized(*size) if fidelity == "default" else camera.multiplied(zoom_x, zoom_y)
    left = int(rng.integers(size[0] - width + 1))
    top = int(rng.integers(size[1] - height + 1))
    part = slice(top, top + height), slice(left, left + width)

    def crop(values: Any, how: int) -> Any:
        return np.ascontiguousarray(cv2.resize(values, size, interpolation=how)[part])

    crops = [crop(image, cv2.INTER_LINEAR) for image in images]
    moved = [crop(values, cv2.INTER_NEAREST_EXACT) for values in maps]
    return crops, moved, enlarged.cropped(left, top, width, height)


def _recolour(images: Images, strength: float, rng: np.random.Generator) -> Images:
    """Brightness, contrast and gamma by one look-up table per channel; gains of the channels differ little."""
    gain = 1 + rng.uniform(-strength, strength)
    gamma = 1 + rng.uniform(-strength, strength)
    contrast = 1 + rng.uniform(-strength, strength)
    tint = 1 + rng.uniform(-strength, strength, 3) / 3
    grey = rng.random() < 0.3
    values = np.arange(256) / 255
    curve = (np.power(values, gamma) - 0.45) * contrast + 0.45
    table = np.clip(np.rint(curve[:, None] * gain * tint * 255), 0, 255).astype(np.uint8)[
        None
    ]  # (1, 256, 3)
    if grey:
        images = [
            cv2.cvtColor(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB) for i in images
        ]
        table = np.repeat(table[..., :1], 3, axis=-1)
    return [cv2.LUT(image, table) for image in images]


def weathered(images: Images, rng: np.random.Generator) -> Images:
    """The same views in time order under random weather; positions of pixels do not change.

    A single image may get cast shadows: those of a snippet would have to move with the road.
    """
    exposure, blur, rain, shadow = rng.random(4) < _EACH
    seen: Pictures = [np.asarray(image / 255, dtype=np.float32) for image in images]
    if shadow and len(seen) == 1:
        seen = [_shadowed(seen[0], rng)]
    if blur:
        seen = _blurred(seen, rng)
    if exposure:
        seen = _exposed(seen, rng)
    if rain:
        seen = _rained_on(seen, rng)
    return [np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8) for image in seen]


def _shadowed(image: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Shadows with soft edges below the upper third: bands across the image, or the spots of leaves."""
    height, width = image.shape[:2]
    shade = np.zeros((height, width), np.float32)
    if rng.random() < 0.5:
        for _ in range(int(rng.integers(1, 4))):
            ends = rng.uniform(0.35, 1.1, 2) * height
            thickness = rng.uniform(0.02, 0.3, 2) * height
            corners = [
                (0, ends[0]),
                (width, ends[1]),
                (width, ends[1] + thickness[1]),
                (0, ends[0] + thickness[0]),
            ]
            cv2.fillConvexPoly(shade, np.rint(corners).astype(np.int32), 1.0)
    else:
        cells = (max(2, int(rng.integers(6, 24))), max(2, int(rng.integers(8, 32))))
        spots = cv2.resize(
            rng.random(cells).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC
        )
        shade[spots < rng.uniform(0.3, 0.6)] = 1
        shade[: int(rng.uniform(0.35, 0.6) * height)] = 0
    shade = cv2.GaussianBlur(shade, (0, 0), float(rng.uniform(0.5, 2.5)))[..., None]
    dark = rng.uniform(0.15, 0.6) * np.array(
        [1, 1, rng.uniform(1, 1.2)]
    )  # the sky's light is bluer than the sun's
    return np.asarray(image * (1 - shade * (1 - dark.astype(np.float32))), np.float32)


def _blurred(images: Pictures, rng: np.random.Generator) -> Pictures:
    """Motion blur of a camera that translates and rotates during the exposure."""
    height, width = images[0].shape[:2]
    approach = float(rng.uniform(0, 0.08))
    yaw = float(rng.normal(0, 0.01)) * width
    rise = float(rng.normal(0, 0.005)) * height
    centre = np.array([width - 1, height - 1]) / 2
    moves = []
    for time in np.linspace(-0.5, 0.5, _BLUR_SAMPLES):
        zoom = 1 + time * approach
        shift = (1 - zoom) * centre + time * np.array([yaw, rise])
        moves.append(np.array([[zoom, 0, shift[0]], [0, zoom, shift[1]]]))
    border = cv2.BORDER_REPLICATE
    blurred = []
    for image in images:
        moved = [cv2.warpAffine(image, move, (width, height), borderMode=border) for move in moves]
        blurred.append(np.asarray(np.mean(moved, axis=0), dtype=np.float32))
    return blurred


def _exposed(images: Pictures, rng: np.random.Generator) -> Pictures:
    """A random gain and gamma, with a jump at a random frame."""
    jump = int(rng.integers(len(images) + 1))
    gains_and_gammas = rng.uniform((0.5, 0.7), (1.6, 1.4), (2, 2)).astype(np.float32)
    exposed = []
    for number, image in enumerate(images):
        gain, gamma = gains_and_gammas[int(number >= jump)]
        exposed.append(gain * np.power(image, gamma))
    return exposed


def _rained_on(images: Pictures, rng: np.random.Generator) -> Pictures:
    """Reduced contrast for the whole snippet, and rain streaks of each frame."""
    height, width = images[0].shape[:2]
    veil, grey = float(rng.uniform(0, 0.35)), float(rng.uniform(0.3, 0.8))
    density, strength = float(rng.uniform(0.001, 0.01)), float(rng.uniform(0.1, 0.5))
    length = max(3, int(height * rng.uniform(0.04, 0.14)))
    slant = float(rng.uniform(-0.4, 0.4))
    streak = np.zeros((length, length), np.float32)
    rows = np.arange(length)
    streak[
        rows, np.clip(np.rint(length / 2 + slant * (rows - length / 2)), 0, length - 1).astype(int)
    ] = 1
    wet = []
    for image in images:
        drops = (rng.random((height, width)) < density).astype(np.float32)
        cover = np.minimum(cv2.filter2D(drops, -1, streak), 1)[..., None] * np.float32(strength)
        hazy = image + np.float32(veil) * (np.float32(grey) - image)
        wet.append(hazy + cover * (np.float32(0.9) - hazy))
    return wet


def training_sample(
    images: list[NDArray[np.uint8]],
    camera: Camera,
    seen: TeacherStructure | None,
    config: ExperimentConfig,
    rng: np.random.Generator,
    fixed: NDArray[np.bool_] | None = None,
) -> dict[str, Tensor]:
    """Augment a snippet and make it a sample.

    Args:
        images: N + 1 in time order at the networks' size, ``(H, W, 3)`` each.
        camera: of these images.
        seen: what the teacher measured, if there is one.
        config: of the experiment.
        rng: of all random draws.
        fixed: where the images show what is fixed to the camera, ``(H, W)``, if that is known.

    Returns:
        Tensors ``target`` (3, H, W) and ``sources`` (N, 3, H, W) in uint8, and ``K`` (3, 3). With a teacher, also
        ``T_source_target`` (N, 4, 4), ``least`` and ``most`` (1, H, W) of `TeacherStructure`. With weather, also
        ``shown`` (N + 1, 3, H, W): the images in time order as the networks see them. With ``fixed``, also that, (1,
        H, W).
    """
    bounds = [] if seen is None else [seen.least.astype(np.float32), seen.most.astype(np.float32)]
    bounds += [] if fixed is None else [fixed.astype(np.float32)]
    images, bounds, varied, mirrored = augment(
        images, bounds, camera, config.data, config.network.fidelity, rng
    )
    sample = as_tensors(images, varied.K)
    if fixed is not None:
        sample["fixed"] = torch.from_numpy(bounds.pop() > 0)[None]
    if seen is not None:
        mirror, nearer = (
            np.diag([-1 if mirrored else 1, 1, 1, 1]).astype(np.float32),
            _nearer(varied, config),
        )
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
    images, maps, varied, _ = augment(
        [image], maps, camera, config.data, config.network.fidelity, rng
    )
    sample = {"target": _stacked(images)[0], "K": torch.from_numpy(varied.K)}
    return sample | _bounds(maps, _nearer(varied, config))


def in_heights(
    inverse_depth: NDArray[np.float32], camera: Camera, config: ExperimentConfig
) -> NDArray[np.float32]:
    """Inverse depth ``(H, W)`` that a network gives for an image, in camera heights."""
    return inverse_depth / np.float32(HEIGHTS * _nearer(camera, config))


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
