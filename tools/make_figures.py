"""The pictures of README and docs, from run folders.

Example: python tools/make_figures.py results/latest docs/images/demo.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from erfsfm.inference import DepthPosePredictor
from slam.results.folder import RunFolder
from slam.results.map_mesh import MapMeshFile
from slam.results.map_picture import MapScene
from slam.results.plots import depth_figure, map_figure, trajectories_of, trajectory_figure
from slam.sequences.catalogue import open_sequence

WIDTH_PX = 1600


def main() -> None:
    """One picture: depth of some frames above the trajectories and the map."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--dataset", type=Path, help="of the run; default: the embedded sequence")
    parser.add_argument("--sequence")
    parser.add_argument("--weights", default="default")
    arguments = parser.parse_args()

    folder = RunFolder.open(arguments.run)
    sequence = open_sequence(arguments.dataset, arguments.sequence, None, None)
    predictor = DepthPosePredictor.from_weights(arguments.weights)
    chosen = np.linspace(0, len(sequence) - 1, 5).round().astype(int)[1:-1]
    images = [sequence.frame(int(k)).image for k in chosen]
    depths = [predictor.depth(image) for image in images]
    trajectories = trajectories_of(folder)
    scene = MapScene(MapMeshFile(folder.require("map_mesh.ply")).reduced(1_000_000))
    top = _raster(depth_figure(images, depths, [f"frame {k}" for k in chosen]), WIDTH_PX)
    left = _raster(trajectory_figure(trajectories, title="trajectories"), WIDTH_PX // 2)
    map_picture = map_figure(scene.from_above(trajectories["optimised"].positions), trajectories["optimised"])
    right = _raster(map_picture, WIDTH_PX - WIDTH_PX // 2)
    height = max(left.shape[0], right.shape[0])
    bottom = np.concatenate([_padded(left, height), _padded(right, height)], axis=1)
    picture = np.concatenate([top, bottom], axis=0)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(arguments.output), picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{arguments.output}: {picture.shape[1]}x{picture.shape[0]}, {arguments.output.stat().st_size / 1e3:.0f} kB")


def _raster(figure: Figure, width: int) -> NDArray[np.uint8]:
    """A figure as pixels of a given width."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    height = round(pixels.shape[0] * width / pixels.shape[1])
    return np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA))


def _padded(picture: NDArray[np.uint8], height: int) -> NDArray[np.uint8]:
    """The picture centred on white of a given height."""
    missing = height - picture.shape[0]
    return np.pad(picture, ((missing // 2, missing - missing // 2), (0, 0), (0, 0)), constant_values=255)


if __name__ == "__main__":
    main()
