"""Receptive fields of networks: theoretical, by gradients, and effective with trained weights, as numbers and drawn.

The paper compares its networks by these fields (its figure 4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from erfsfm.checkpoint import Model
from erfsfm.common.errors import ConfigError
from erfsfm.common.files import save_figure
from erfsfm.common.table import Table
from erfsfm.config import Fidelity
from erfsfm.networks.presets import PRESETS, build
from erfsfm.networks.receptive_field import (
    MeasuredField,
    Network,
    field_of,
    measured,
    share_read,
    theoretical,
    theoretical_corner,
)

# Supports do not depend on the width; effective fields of untrained networks hardly do.
_PROBE_WIDTH = 0.1
_UNTRAINED_WIDTH = 0.25
HELD = 0.95
_WIDTH_IN = 12.0
_DIM = 0.3  # brightness of pixels that are never read
_BOX, _MEASURED, _HEAT = "#ffd23f", "#3ec7f2", "inferno"
_TITLE = (
    "Receptive field of the middle output of the last encoder layer\nleft: bright pixels can reach it; blue: their "
    f"bounding box; dashed: theoretical box.  right: gradient magnitude, {HELD:.0%} of which is in the stated share"
)
_HEIGHT_M, _HALF_WIDTH_M = (
    1.65,
    7.0,
)  # of the synthetic street: camera over the road, and walls beside it
_FOCAL_SHARE = 0.58  # focal length over image width, as KITTI's


@dataclass(frozen=True)
class FieldRow:
    """One network's fields, of the middle pixel of its last encoder layer.

    Attributes:
        title: the network's name, marked where it is the paper's.
        summary: the numbers by name, in pixels and fractions of the image, with taps pushed by ``offsets_px``.
        corner: image row and column of the theoretical box, taps pushed.
        seen: support of the pixel's gradient, with constant weights.
        weighed: effective field on an image.
    """

    title: str
    summary: dict[str, Any]
    corner: tuple[int, int]
    seen: MeasuredField
    weighed: MeasuredField


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
        raise ConfigError(
            f"receptive fields are measured on 5 consecutive images; got {len(snippet)}"
        )
    wanted: list[tuple[str, Fidelity]] = []
    for name in names:
        wanted.append((name, fidelity))
        if name == "erf-posenet-dilated" and fidelity == "default":
            wanted.append((name, "paper"))
    return [_row(*which, snippet, offsets_px, learned, device) for which in wanted]


def field_table(rows: Sequence[FieldRow]) -> Table:
    """The summaries of rows."""
    texts = []
    for row in rows:
        numbers = row.summary
        shares = (numbers[key] for key in ("share", "share_of_all_outputs", "effective_share_95"))
        box = f"{row.seen.columns} x {row.seen.rows}"
        start = [row.title, numbers["weights"], f"{numbers['theoretical_px']} px", box]
        texts.append([*start, *(f"{share:.1%}" for share in shares)])
    head = ["network", "weights", "theory", "columns x rows", "share", "all outputs", "95 % in"]
    return Table(head, texts, names=2)


def draw_fields(rows: Sequence[FieldRow], image: NDArray[np.uint8], path: Path) -> None:
    """Write the figure: a row for each network, its support on the left, its effective field on the right.

    Args:
        rows: what to show.
        image: ``(H, W, 3)`` uint8 RGB, the middle image of the input snippet.
        path: its ending names the format: png, pdf or svg.
    """
    height, width = image.shape[:2]
    panel = _WIDTH_IN / 2 * height / width
    figure = Figure(figsize=(_WIDTH_IN, (panel + 0.2) * len(rows) + 0.6), layout="constrained")
    for row, (left, right) in zip(rows, figure.subplots(len(rows), 2, squeeze=False)):
        _draw_seen(left, row, image)
        _draw_weighed(right, row, image)
        for axis in (left, right):
            axis.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    figure.suptitle(_TITLE, fontsize=9)
    save_figure(figure, path, dpi=150)


def _draw_seen(axis: Axes, row: FieldRow, image: NDArray[np.uint8]) -> None:
    field, side, offsets_px = row.seen, row.summary["theoretical_px"], row.summary["offsets_px"]
    read = field.gradient.cpu().numpy() > 0
    axis.imshow(
        np.where(read[..., None], image, (image * _DIM).astype(np.uint8)), interpolation="nearest"
    )
    boxes = [(*row.corner, side, side, _BOX, "--")]
    boxes += (
        [(field.top, field.left, field.rows, field.columns, _MEASURED, "-")] if field.rows else []
    )
    for top, left, rows, columns, colour, style in boxes:
        axis.add_patch(
            Rectangle(
                (left - 0.5, top - 0.5),
                columns,
                rows,
                fill=False,
                edgecolor=colour,
                linestyle=style,
            )
        )
    taps = f", taps pushed {offsets_px:g} px" if offsets_px else ""
    said = f"{row.title}{taps}: {side} px in theory, box {field.columns} x {field.rows}"
    axis.set_title(f"{said}, {field.coverage:.1%} of the image", fontsize=7.5, loc="left", pad=3)


def _draw_weighed(axis: Axes, row: FieldRow, image: NDArray[np.uint8]) -> None:
    weight = row.weighed.gradient.cpu().double().numpy()
    axis.imshow(np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8), alpha=0.5)
    strength = np.sqrt(weight / max(weight.max(), 1e-30))
    axis.imshow(strength, cmap=_HEAT, alpha=np.clip(1.6 * strength, 0, 0.95), vmin=0, vmax=1)
    ratio = row.summary["effective_share_95"]
    extent = (
        f"{HELD:.0%} in {ratio:.1%} of the image"
        if ratio
        else "nothing: no pixel influences the output"
    )
    axis.set_title(f"weights: {row.summary['weights']}; {extent}", fontsize=7.5, loc="left", pad=3)


def _row(
    name: str,
    fidelity: Fidelity,
    snippet: Sequence[NDArray[np.uint8]],
    offsets_px: float,
    learned: tuple[str, Model] | None,
    device: str,
) -> FieldRow:
    probe = build(name, fidelity, _PROBE_WIDTH).to(device)
    height, width = snippet[0].shape[:2]
    size = (height, width)
    pushed = offsets_px if any(layer.deformable for layer in probe.encoder.layers()) else 0.0
    seen = measured(probe, size, offsets_px=pushed)
    network, weights = build(name, fidelity, _UNTRAINED_WIDTH), "untrained"
    if learned is not None:  # where they are of this preset
        title, model = learned
        config, kind = model.record.network, PRESETS[name].kind
        trained = model.networks.get(kind)
        if (getattr(config, kind), config.fidelity) == (name, fidelity) and isinstance(
            trained, Network
        ):
            network, weights = trained, title
    # the middle image ``(1, C, H, W)`` in [-1, 1], for a pose network with its sources behind it
    sources, middle = network.input_channels // 3 - 1, len(snippet) // 2
    around = [
        i for i in range(middle - sources // 2, middle + (sources + 1) // 2 + 1) if i != middle
    ]
    images = (
        np.stack([snippet[i] for i in (middle, *around)])
        .transpose(0, 3, 1, 2)
        .reshape(1, -1, *size)
    )
    shown = torch.from_numpy(images).float() / 127.5 - 1
    weighed = field_of(network.encoder.eval().to(device), shown.to(device))
    summary = {
        "name": name,
        "fidelity": fidelity,
        "offsets_px": pushed,
        "theoretical_px": theoretical(probe, pushed),
        "theoretical_at_rest_px": theoretical(probe),
        "rows": seen.rows,
        "columns": seen.columns,
        "share": seen.coverage,
        "share_of_all_outputs": share_read(probe, size, pushed),
        "effective_share_95": weighed.share_holding(HELD),
        "weights": weights,
    }
    title = f"{name} (paper)" if fidelity == "paper" else name
    return FieldRow(title, summary, theoretical_corner(probe, seen.pixel, pushed), seen, weighed)


def street_snippet(frames: int, height: int, width: int) -> list[NDArray[np.uint8]]:
    """Consecutive views ``(height, width, 3)`` uint8 RGB of a straight drive between walls, a metre a frame."""
    v, u = np.mgrid[:height, :width]
    ray_x = (u - (width - 1) / 2) / (_FOCAL_SHARE * width)
    ray_y = (v - (height - 1) / 2) / (_FOCAL_SHARE * width)
    to_road = _HEIGHT_M / np.maximum(ray_y, 1e-6)  # z-depth in metres
    to_wall = _HALF_WIDTH_M / np.maximum(np.abs(ray_x), 1e-6)
    depth = np.minimum(to_road, to_wall)
    x, y, wall = ray_x * depth, ray_y * depth, to_wall < to_road
    across, views = np.where(wall, y, x), []
    for z in (z_m + depth for z_m in range(frames)):
        lane = (np.abs(np.abs(x) - 2) < 0.12) & (np.mod(z, 6) < 3)
        window = (np.mod(z, 3) < 1.2) & (np.mod(y, 2.5) < 1.3)
        grain = np.mean(
            [np.sin(a * across + b * z + a * b) for a, b in ((2.1, 1.3), (5.3, -3.1), (-9.7, 7.9))],
            axis=0,
        )
        shade = np.where(wall, 0.62 - 0.3 * window, 0.33 + 0.5 * lane) + 0.1 * grain
        shade = np.where(wall & (y < -6), 0.92, shade / (1 + depth / 300))  # sky above the walls
        views.append(
            np.repeat(np.rint(255 * np.clip(shade, 0, 1)).astype(np.uint8)[..., None], 3, axis=2)
        )
    return views
