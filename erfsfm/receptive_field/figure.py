"""The figure of measured receptive fields: theoretical box, support and effective field of each network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from erfsfm.common.files import save_figure
from erfsfm.receptive_field.measure import HELD, FieldRow

_WIDTH_IN = 12.0
_DIM = 0.3  # brightness of pixels that are never read
_BOX, _MEASURED, _HEAT = "#ffd23f", "#3ec7f2", "inferno"
_COMB_RATIO = 0.5  # a field that reads less of its own box than this is shown magnified
_COMB_PX = 13
_UNREAD = (24, 32, 64)


def draw_fields(rows: Sequence[FieldRow], image: NDArray[np.uint8], path: Path) -> None:
    """Write the figure: a row for each network, its support on the left, its effective field on the right.

    Args:
        rows: what to show.
        image: ``(H, W, 3)`` uint8 RGB, the middle image of the input snippet.
        path: its ending names the format: png, pdf or svg.
    """
    height, width = image.shape[:2]
    panel = _WIDTH_IN / 2 * height / width
    layout = ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.03, hspace=0.02)
    figure = Figure(figsize=(_WIDTH_IN, (panel + 0.2) * len(rows) + 0.6), layout=layout)
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(rows), 2, squeeze=False)
    for row, (left, right) in zip(rows, axes):
        _draw_seen(left, row, image)
        _draw_weighed(right, row, image)
        for axis in (left, right):
            axis.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    figure.suptitle(
        "Receptive field of the middle output of the last encoder layer\n"
        "left: bright pixels can reach it; blue: their bounding box; dashed: theoretical box, where it ends inside "
        f"the image.  right: gradient magnitude; line: {HELD:.0%} of it",
        fontsize=9,
    )
    save_figure(figure, path, dpi=150)


def _draw_seen(axis: Axes, row: FieldRow, image: NDArray[np.uint8]) -> None:
    read = row.seen.gradient.cpu().numpy() > 0
    axis.imshow(np.where(read[..., None], image, (image * _DIM).astype(np.uint8)), interpolation="nearest")
    top, left = row.corner
    field = row.seen
    if field.rows:
        axis.add_patch(_rectangle(field.top, field.left, field.rows, field.columns, _MEASURED, "-"))
        if field.coverage * read.size < _COMB_RATIO * field.rows * field.columns:
            _magnify(axis, read, image)
    axis.add_patch(_rectangle(top, left, row.side_px, row.side_px, _BOX, (0, (4, 4))))
    taps = f", taps pushed {row.offsets_px:g} px" if row.offsets_px else ""
    fidelity = " (paper)" if row.fidelity == "paper" else ""
    axis.set_title(
        f"{row.name}{fidelity}{taps}: {row.side_px} px in theory, box {field.columns} x {field.rows}, "
        f"{field.coverage:.1%} of the image",
        fontsize=7.5,
        loc="left",
        pad=3,
    )


def _draw_weighed(axis: Axes, row: FieldRow, image: NDArray[np.uint8]) -> None:
    weight = row.weighed.gradient.cpu().double().numpy()
    axis.imshow(np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8), alpha=0.5)
    strength = np.sqrt(weight / weight.max()) if weight.max() > 0 else weight
    axis.imshow(strength, cmap=_HEAT, alpha=np.clip(1.6 * strength, 0, 0.95), vmin=0, vmax=1)
    if weight.max() > 0:
        axis.contour(_smoothed_core(weight), levels=[0.5], colors=_MEASURED, linewidths=1.0)
    ratio = row.weighed.share_holding(HELD)
    extent = f"{HELD:.0%} in {ratio:.1%} of the image" if ratio else "nothing: no pixel influences the output"
    axis.set_title(f"weights: {row.weights}; {extent}", fontsize=7.5, loc="left", pad=3)


def _smoothed_core(weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Near 1 where the pixels with most of the gradient are dense; isolated pixels are smoothed away."""
    import cv2

    blurred = cv2.GaussianBlur(weight, (0, 0), sigmaX=4)
    ordered = np.sort(blurred.ravel())[::-1]
    held = np.searchsorted(np.cumsum(ordered), HELD * ordered.sum())
    core: NDArray[np.float64] = (blurred >= ordered[min(held, ordered.size - 1)]).astype(np.float64)
    return core


def _magnify(axis: Axes, read: NDArray[np.bool_], image: NDArray[np.uint8]) -> None:
    """A few pixels of the field, enlarged and brightened: single skipped pixels are invisible in the figure."""
    rows, columns = np.nonzero(read)
    top = int(np.median(rows)) - _COMB_PX // 2
    left = int(np.median(columns)) - _COMB_PX // 2
    window = (slice(top, top + _COMB_PX), slice(left, left + _COMB_PX))
    shown = np.where(read[window][..., None], image[window] // 2 + 127, np.array(_UNREAD, dtype=np.uint8))
    inset = axis.inset_axes((0.775, 0.08, 0.21, 0.84))
    inset.imshow(shown, interpolation="nearest")
    inset.set(xticks=[], yticks=[])
    for spine in inset.spines.values():
        spine.set(edgecolor="white", linewidth=1.2)
    label = {"facecolor": "black", "edgecolor": "none", "pad": 1.0}
    inset.text(
        0.5,
        0.03,
        f"{_COMB_PX} x {_COMB_PX} px",
        fontsize=6,
        color="white",
        ha="center",
        bbox=label,
        transform=inset.transAxes,
    )


def _rectangle(
    top: int, left: int, rows: int, columns: int, colour: str, style: str | tuple[int, tuple[int, int]]
) -> Rectangle:
    return Rectangle(
        (left - 0.5, top - 0.5), columns, rows, fill=False, edgecolor=colour, linestyle=style, linewidth=1.4
    )
