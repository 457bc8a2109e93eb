"""Depth maps of a drive in one picture, and their errors over distance: image, network, refined depth, truth.

Runs the whole system with each of the weights, and refines depth in each of the ways; depth is in metres as the run
gives it, no scale is fitted, and what is beyond 80 m counts as 80 m. Means have the standard error of blocks of five
keyframes.

Example: python tools/depth_page.py docs/images/depth-0013.jpg --dataset KITTI_RAW/DRIVE --show 12 28
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from shared.command import markdown, one_line_errors, parser_of

from erfsfm.inference import DepthPosePredictor, save_image
from slam.config.sections import load_config
from slam.frames import DepthMap, Image
from slam.frames import Sequence as FrameSequence
from slam.mapping.filters import KeyframeDepth
from slam.pipeline.batch import SlamPipeline
from slam.prediction.networks import NetworkPredictor
from slam.results.depth import true_depth
from slam.sequences.catalogue import open_sequence

EDGES_M = (1, 5, 10, 20, 40, 80)
WIDTH_PX = 416
NEAREST_M = 4.0  # of the colour scale
RIM_PX = 6
BLOCK = 5  # keyframes

Errors = dict[str, dict[int, NDArray[np.float64]]]  # by method and frame: rows of truth and relative error


@dataclass(frozen=True)
class Shown:
    """A row of the picture."""

    image: Image
    depths: dict[str, DepthMap]
    truth: DepthMap | None


@one_line_errors()
def main(words: Sequence[str] | None = None) -> None:
    """Run with each of the weights, draw, print one table."""
    options = _parser().parse_args(words)
    errors: Errors = {}
    shown: dict[int, Shown] = {}
    drive = open_sequence(options.dataset, options.sequence, None, options.frames)
    for weights in options.weights:
        run(drive, weights, options, partial(_note, drive, Path(weights).name, errors, shown))
    rows = [shown[min(shown, key=lambda index: abs(index - wanted))] for wanted in options.show]
    save_image(options.output, picture(rows))
    print(table(errors))


def run(
    drive: FrameSequence, weights: str, options: argparse.Namespace, note: Callable[[str, KeyframeDepth], None]
) -> None:
    """The whole system on a drive; ``note`` is told each way to refine, and the depth of every keyframe."""
    networks = DepthPosePredictor.from_weights(weights, "cpu")
    predictor = NetworkPredictor(networks, drive.intrinsics)
    estimate = None
    for way in options.refine:
        config = load_config(None, [*options.set, f"depth.refine={way}"])
        pipeline = SlamPipeline(drive, predictor, config)
        estimate = estimate or pipeline.estimate()
        pipeline.fuse(estimate, partial(note, way))


def _note(
    drive: FrameSequence, name: str, errors: Errors, shown: dict[int, Shown], way: str, keyframe: KeyframeDepth
) -> None:
    """Keep a keyframe's maps and errors."""
    depths = {name: keyframe.depth}
    if keyframe.network_depth is not None:
        depths = {name: keyframe.network_depth, f"{name}, {way}": keyframe.depth}
    truth = true_depth(drive, keyframe.frame)
    before = shown.get(keyframe.frame)
    shown[keyframe.frame] = Shown(keyframe.image, (before.depths if before else {}) | depths, truth)
    if truth is None:
        return
    known = (truth >= EDGES_M[0]) & (truth < EDGES_M[-1])
    for method, depth in depths.items():
        size = (truth.shape[1], truth.shape[0])
        guess = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT).astype(np.float64)
        both = known & np.isfinite(guess)
        relative = np.abs(np.minimum(guess[both], EDGES_M[-1]) - truth[both]) / truth[both]
        errors.setdefault(method, {})[keyframe.frame] = np.stack([truth[both], relative])


def table(errors: Errors) -> str:
    """Mean, its standard error, and median of each method's relative error, whole and over distance, as Markdown."""
    bins = [(EDGES_M[0], EDGES_M[-1]), *pairwise(EDGES_M)]
    rows = [[method, *(_cell([*parts.values()], *edges) for edges in bins)] for method, parts in errors.items()]
    return markdown(["depth", "all", *(f"{a}-{b} m" for a, b in bins[1:])], rows)


def _cell(keyframes: Sequence[NDArray[np.float64]], least: float, most: float) -> str:
    chosen = [relative[(truth >= least) & (truth < most)] for truth, relative in keyframes]
    everything = np.concatenate(chosen)
    if not len(everything):
        return "-"
    joined = [np.concatenate(chosen[n : n + BLOCK]) for n in range(0, len(chosen), BLOCK)]
    blocks = [block for block in joined if len(block)]
    sizes, means = np.array([len(block) for block in blocks]), np.array([block.mean() for block in blocks])
    off = sizes * (means - everything.mean())
    share = np.sqrt(len(blocks) / max(len(blocks) - 1, 1))
    error = share * np.linalg.norm(off) / sizes.sum() if len(blocks) > 1 else np.nan
    return f"{everything.mean():.3f} ± {error:.3f} / {np.median(everything):.3f}"


def picture(rows: Sequence[Shown]) -> Image:
    """Rows of frames, columns image, methods and truth, with their names above."""
    names = list(rows[0].depths)
    titles = ["image", *names, *(["truth"] if any(row.truth is not None for row in rows) else [])]
    lines = []
    for row in rows:
        height = round(WIDTH_PX * row.image.shape[0] / row.image.shape[1])
        cells = [np.asarray(cv2.resize(row.image, (WIDTH_PX, height), interpolation=cv2.INTER_AREA), np.uint8)]
        cells += [coloured(row.depths[name], height) for name in names]
        if row.truth is not None:
            cells.append(coloured(row.truth, height, cv2.INTER_NEAREST))
        lines.append(
            np.concatenate([np.pad(cell, ((0, RIM_PX), (0, RIM_PX), (0, 0)), constant_values=255) for cell in cells], 1)
        )
    head = np.full((24, lines[0].shape[1], 3), 255, np.uint8)
    for column, title in enumerate(titles):
        place = column * (WIDTH_PX + RIM_PX) + 4, 17
        cv2.putText(head, title, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([head, *lines])


def coloured(depth: DepthMap, height: int, interpolation: int = cv2.INTER_AREA) -> Image:
    """Inverse depth on one scale for all: bright is near, 4 m and nearer the brightest; few points are enlarged."""
    inverse = np.where(depth > 0, NEAREST_M / np.maximum(depth, 1e-6), 0).astype(np.float32)
    if (depth > 0).mean() < 0.5:
        inverse = cv2.dilate(inverse, np.ones((5, 3), np.uint8))
    inverse = cv2.resize(inverse, (WIDTH_PX, height), interpolation=interpolation)
    shade = np.clip(np.sqrt(inverse) * 255, 0, 255).astype(np.uint8)
    colours = np.ascontiguousarray(cv2.applyColorMap(shade, cv2.COLORMAP_MAGMA)[..., ::-1])
    colours[inverse == 0] = 128
    return colours


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("output", type=Path, help=".jpg or .png")
    add("--dataset", type=Path, help="as for erfsfm-slam run; default: the embedded sequence")
    add("--sequence")
    add("--frames", metavar="A:B", help="half-open")
    add("--weights", nargs="+", default=["default"])
    add("--refine", nargs="+", default=["multiview", "learned"], choices=["multiview", "learned"])
    add("--set", nargs="+", default=(), metavar="KEY=VALUE", help="of the run")
    add("--show", nargs="+", type=int, default=[20, 60], help="frames; the nearest keyframes are shown")
    return parser


if __name__ == "__main__":
    main()
