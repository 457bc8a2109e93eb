"""Receptive fields of networks: theoretical, by gradients, and effective with trained weights; a street to see."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from erfsfm.checkpoint import Model
from erfsfm.common.errors import ConfigError
from erfsfm.common.readers.kitti_calibration import CAMERA_HEIGHT_M
from erfsfm.common.table import Table
from erfsfm.config import Fidelity
from erfsfm.networks.presets import PRESETS, build
from erfsfm.networks.receptive_field import MeasuredField, Network, effective, measured, theoretical, theoretical_corner

# Supports do not depend on the width; effective fields of untrained networks hardly do.
_PROBE_WIDTH = 0.1
_UNTRAINED_WIDTH = 0.25
HELD = 0.95
_HALF_WIDTH_M = 7.0
_FOCAL_SHARE = 0.58  # focal length over image width, as KITTI's


@dataclass(frozen=True)
class FieldRow:
    """One network's fields, of the middle pixel of its last encoder layer.

    Attributes:
        name: preset.
        fidelity: ``paper`` or ``default``.
        offsets_px: outward offset of deformable taps in `seen`, pixels; 0 for other networks.
        side_px: theoretical side with taps moved by `offsets_px`.
        side_at_rest_px: theoretical side at zero offsets.
        corner: image row and column of the theoretical box, taps moved.
        seen: support of the pixel's gradient, with constant weights.
        union_share: fraction of the image in the support of any pixel of the layer.
        weighed: effective field on an image, with the weights named by `weights`.
        weights: name of the learned weights, or ``untrained``.
    """

    name: str
    fidelity: Fidelity
    offsets_px: float
    side_px: int
    side_at_rest_px: int
    corner: tuple[int, int]
    seen: MeasuredField
    union_share: float
    weighed: MeasuredField
    weights: str

    def summary(self) -> dict[str, Any]:
        """The numbers by name, in pixels and fractions of the image."""
        return {
            "name": self.name,
            "fidelity": self.fidelity,
            "offsets_px": self.offsets_px,
            "theoretical_px": self.side_px,
            "theoretical_at_rest_px": self.side_at_rest_px,
            "rows": self.seen.rows,
            "columns": self.seen.columns,
            "share": self.seen.coverage,
            "share_of_all_outputs": self.union_share,
            "effective_share_95": self.weighed.share_holding(HELD),
            "weights": self.weights,
        }


def measure_fields(
    names: Sequence[str],
    fidelity: Fidelity,
    snippet: Sequence[NDArray[np.uint8]],
    offsets_px: float = 1.0,
    learned: tuple[str, Model] | None = None,
    device: str = "cpu",
) -> list[FieldRow]:
    """Fields of presets; with the default dilated pose network also the paper's, which skips three pixels of four.

    Args:
        names: keys of `PRESETS`.
        fidelity: of all networks.
        snippet: five images ``(H, W, 3)`` uint8 RGB in time order; depth networks see the middle one.
        offsets_px: outward offset of deformable taps, pixels.
        learned: name and weights to take effective fields from, for the presets that they are of.
        device: where to compute.

    Raises:
        ConfigError: an unknown name, or a snippet that is not five images.
    """
    if len(snippet) != 5:
        raise ConfigError(f"receptive fields are measured on 5 consecutive images; got {len(snippet)}")
    wanted: list[tuple[str, Fidelity]] = []
    for name in names:
        wanted.append((name, fidelity))
        if name == "erf-posenet-dilated" and fidelity == "default":
            wanted.append((name, "paper"))
    return [_row(*which, snippet, offsets_px, learned, device) for which in wanted]


def field_table(rows: Sequence[FieldRow]) -> Table:
    """The summaries of rows."""
    texts = []
    for row in (row.summary() for row in rows):
        name = row["name"] + (" (paper)" if row["fidelity"] == "paper" else "")
        ratios = (f"{row[key]:.1%}" for key in ("share", "share_of_all_outputs", "effective_share_95"))
        box = f"{row['columns']} x {row['rows']}"
        texts.append([name, row["weights"], f"{row['theoretical_px']} px", box, *ratios])
    head = ["network", "weights", "theory", "columns x rows", "share", "all outputs", "95 % in"]
    return Table(head, texts, names=2)


def _row(
    name: str,
    fidelity: Fidelity,
    snippet: Sequence[NDArray[np.uint8]],
    offsets_px: float,
    learned: tuple[str, Model] | None,
    device: str,
) -> FieldRow:
    probe = build(name, fidelity, _PROBE_WIDTH).to(device)
    size = snippet[0].shape[:2]
    pushed = offsets_px if any(layer.deformable for layer in probe.encoder_layers()) else 0.0
    seen = measured(probe, size, offsets_px=pushed)
    network, weights = _with_weights(name, fidelity, learned)
    return FieldRow(
        name=name,
        fidelity=fidelity,
        offsets_px=pushed,
        side_px=theoretical(probe, pushed),
        side_at_rest_px=theoretical(probe),
        corner=theoretical_corner(probe, seen.pixel, pushed),
        seen=seen,
        union_share=_union_share(probe, size, pushed, seen.map_size),
        weighed=effective(network.to(device), _encoder_input(snippet, network).to(device)),
        weights=weights,
    )


def _with_weights(name: str, fidelity: Fidelity, learned: tuple[str, Model] | None) -> tuple[Network, str]:
    """The learned network if it is of this preset, else a fresh one."""
    if learned is not None:
        title, model = learned
        config, kind = model.record.network, PRESETS[name].kind
        trained = model.depth_net if kind == "depth" else model.pose_net
        same = (config.depth if kind == "depth" else config.pose) == name and config.fidelity == fidelity
        if same and isinstance(trained, Network):
            return trained, title
    return build(name, fidelity, _UNTRAINED_WIDTH), "untrained"


def _union_share(network: Network, size: tuple[int, int], offsets_px: float, map_size: tuple[int, int]) -> float:
    """Fraction of the image's pixels with a gradient to any output pixel."""
    pixels = itertools.product(range(map_size[0]), range(map_size[1]))
    fields = [measured(network, size, pixel, offsets_px).gradient > 0 for pixel in pixels]
    return float(torch.stack(fields).any(dim=0).double().mean())


def _encoder_input(snippet: Sequence[NDArray[np.uint8]], network: Network) -> Tensor:
    """``(1, C, H, W)`` in [-1, 1]: the middle image, for a pose network with its sources behind it."""
    sources = network.input_channels // 3 - 1
    middle = len(snippet) // 2
    around = [i for i in range(middle - sources // 2, middle + (sources + 1) // 2 + 1) if i != middle]
    images = np.stack([snippet[middle], *(snippet[i] for i in around)])
    stacked = torch.from_numpy(images).permute(0, 3, 1, 2)  # (1 + N, 3, H, W)
    return stacked.reshape(1, -1, *images.shape[1:3]).float() / 127.5 - 1


def street_snippet(frames: int, height: int, width: int, step_m: float = 1.0) -> list[NDArray[np.uint8]]:
    """Consecutive views of a straight drive, in time order.

    Args:
        frames: how many.
        height: of each view, pixels.
        width: of each view, pixels.
        step_m: forward motion between views.

    Returns:
        Images ``(height, width, 3)`` uint8 RGB.
    """
    return [_view(height, width, k * step_m) for k in range(frames)]


def _view(height: int, width: int, z_m: float) -> NDArray[np.uint8]:
    v, u = np.mgrid[:height, :width]
    ray_x = (u - (width - 1) / 2) / (_FOCAL_SHARE * width)
    ray_y = (v - (height - 1) / 2) / (_FOCAL_SHARE * width)
    to_road = CAMERA_HEIGHT_M / np.maximum(ray_y, 1e-6)  # z-depth in metres
    to_wall = _HALF_WIDTH_M / np.maximum(np.abs(ray_x), 1e-6)
    depth = np.minimum(to_road, to_wall)
    x, y, z = ray_x * depth, ray_y * depth, z_m + depth
    wall = to_wall < to_road
    sky = wall & (y < -6 - 2 * np.sin(np.floor(z / 9) * 2.4))
    lane = (np.abs(np.abs(x) - 2) < 0.12) & (np.mod(z, 6) < 3)
    window = (np.mod(z, 3) < 1.2) & (np.mod(y, 2.5) < 1.3)
    shade = np.where(wall, 0.62 - 0.3 * window, 0.33 + 0.5 * lane) + 0.1 * _grain(np.where(wall, y, x), z)
    shade = np.where(sky, 0.92, shade / (1 + depth / 300))
    tint = np.where(sky[..., None], [0.85, 0.93, 1.0], np.where(wall[..., None], [1.0, 0.9, 0.8], [0.95, 0.97, 1.0]))
    return np.asarray(np.rint(255 * np.clip(shade[..., None] * tint, 0, 1)), dtype=np.uint8)


def _grain(across: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64]:
    """A texture in [-1, 1] fixed to the world."""
    waves = [np.sin(a * across + b * along + a * b) for a, b in ((2.1, 1.3), (5.3, -3.1), (-9.7, 7.9), (3.3, 0.4))]
    texture: NDArray[np.float64] = np.mean(waves, axis=0)
    return texture
