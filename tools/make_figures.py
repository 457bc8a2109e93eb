"""The pictures of README and docs, from run folders: trajectories by matplotlib, the map by casting rays at it.

Example: python tools/make_figures.py results/latest docs/images/demo.png
Example: python tools/make_figures.py results/latest docs/images/map-0013.jpg --dataset DRIVE_0013 --seat 80
Example: python tools/make_figures.py results/latest docs/images/map-rooms.jpg --dataset HOUSE --seat 20 70
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, FigureBase
from numpy.typing import NDArray
from shared.command import one_line_errors, parser_of

from erfsfm.inference import DepthPosePredictor, colour_disparity
from slam.evaluation.trajectory import aligned
from slam.formats.trajectory import Trajectory
from slam.frames import Sequence
from slam.geometry.se3 import FloatArray
from slam.results.folder import RunFolder
from slam.results.report.figures import LOOKS, Mesh, thinned_mesh
from slam.results.report.page import narrowed
from slam.runtime.files import MAP_MESH, REFERENCE, TRAJECTORIES
from slam.runtime.imports import import_open3d
from slam.simulation.recording import open_or_embedded

WIDTH_PX = 1600
SEAT_PX = 1280, 720
MOST_TRIANGLES = 4_000_000
STYLE: dict[str, Any] = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
}
STYLE |= {
    "axes.axisbelow": True,
    "grid.color": "#e3e6ea",
    "legend.fontsize": 9,
    "legend.frameon": False,
}
SKY = (226, 232, 239)
_DASHES = {"dash": "dashed", "dot": "dotted"}


@one_line_errors()
def main() -> None:
    """One picture: depth of some frames above trajectories and map, or frames above the map as they see it."""
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("run", type=Path)
    add("output", type=Path)
    add("--dataset", type=Path, help="of the run; default: the embedded sequence")
    add("--sequence")
    add("--weights", default="default")
    add("--seat", type=int, nargs="+", metavar="FRAME", help="the map as these see it, below them")
    arguments = parser.parse_args()

    folder = RunFolder.open(arguments.run)
    sequence = open_or_embedded(arguments.dataset, arguments.sequence, None, None)
    if arguments.seat is None:
        picture = overview(folder, sequence, DepthPosePredictor.from_weights(arguments.weights))
    else:
        picture = np.hstack([seat(folder, sequence, frame) for frame in arguments.seat])
        if picture.shape[1] > WIDTH_PX:
            picture = narrowed(picture, WIDTH_PX)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    small = (
        [cv2.IMWRITE_PNG_COMPRESSION, 9]
        if arguments.output.suffix == ".png"
        else [cv2.IMWRITE_JPEG_QUALITY, 85]
    )
    cv2.imwrite(str(arguments.output), picture[..., ::-1], small)
    print(
        f"{arguments.output}: {picture.shape[1]}x{picture.shape[0]}, {arguments.output.stat().st_size / 1e3:.0f} kB"
    )


def seat(folder: RunFolder, sequence: Sequence, frame: int) -> NDArray[np.uint8]:
    """A frame above what a camera at its place sees of the map."""
    T_world_camera = trajectories_of(folder)["optimised"].T_world_camera[frame]
    u, v = np.meshgrid(
        np.arange(SEAT_PX[0]) - 0.5 * SEAT_PX[0], np.arange(SEAT_PX[1]) - 0.5 * SEAT_PX[1]
    )
    rays = np.stack([u, v, np.full_like(u, SEAT_PX[1])], axis=-1) @ T_world_camera[:3, :3].T
    below = cast(
        thinned_mesh(folder.require(MAP_MESH), MOST_TRIANGLES), T_world_camera[:3, 3], rays
    )
    image = sequence.frame(frame).image
    return np.concatenate([narrowed(image, below.shape[1]), below])


def overview(
    folder: RunFolder, sequence: Sequence, predictor: DepthPosePredictor
) -> NDArray[np.uint8]:
    """Depth of some frames above the trajectories and the map."""
    chosen = np.linspace(0, len(sequence) - 1, 5).round().astype(int)[1:-1]
    images = [sequence.frame(int(k)).image for k in chosen]
    strips = [np.concatenate([image, colour_disparity(predictor.depth(image))]) for image in images]
    trajectories = trajectories_of(folder)
    top = narrowed(np.concatenate(strips, axis=1), WIDTH_PX)
    with rc_context(STYLE):
        figure = Figure(figsize=(7.4, 5.6), layout="constrained")
        draw_trajectories(figure, trajectories, "m")
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        left = narrowed(np.asarray(canvas.buffer_rgba())[..., :3], WIDTH_PX // 2)
    right = above(thinned_mesh(folder.require(MAP_MESH), MOST_TRIANGLES), WIDTH_PX - WIDTH_PX // 2)
    height = max(left.shape[0], right.shape[0])
    bottom = np.concatenate([_padded(left, height), _padded(right, height)], axis=1)
    return np.concatenate([top, bottom], axis=0)


def above(mesh: Mesh, width: int) -> NDArray[np.uint8]:
    """The map from above; z ahead is up."""
    points = mesh[0]
    (x0, z0), (x1, z1) = (
        np.percentile(points[:, [0, 2]], percent, axis=0) for percent in (0.5, 99.5)
    )
    x, z = np.meshgrid(np.linspace(x0, x1, width), np.arange(z1, z0, -(x1 - x0) / width))
    origins = np.stack([x, np.full_like(x, points[:, 1].min() - 1.0), z], axis=-1)
    return cast(mesh, origins, np.array([0.0, 1.0, 0.0]))


def trajectories_of(folder: RunFolder) -> dict[str, Trajectory]:
    """The trajectories of a run, the reference first."""
    found = {name: folder.trajectory(name) for name in (REFERENCE, *TRAJECTORIES)}
    return {name: trajectory for name, trajectory in found.items() if trajectory is not None}


def draw_trajectories(
    canvas: FigureBase, trajectories: Mapping[str, Trajectory], unit: str
) -> Axes:
    """Draw them on a figure or a part of one, aligned to the reference where there is one."""
    axes = canvas.subplots()
    for name, trajectory in aligned(trajectories).items():
        label, colour, width, dash = LOOKS[name]
        look: dict[str, Any] = {
            "color": colour or "black",
            "linewidth": width,
            "linestyle": _DASHES.get(dash, dash),
        }
        axes.plot(trajectory.positions[:, 0], trajectory.positions[:, 2], label=label, **look)
    axes.set(xlabel=f"x, right ({unit})", ylabel=f"z, ahead ({unit})")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    axes.legend()
    return axes


def cast(mesh: Mesh, origins: FloatArray, directions: FloatArray) -> NDArray[np.uint8]:
    """Colours ``(H, W, 3)`` where rays ``(H, W, 3)`` meet a mesh, and of the sky elsewhere."""
    o3d = import_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    points, colours, triangles = mesh
    scene.add_triangles(points.astype(np.float32), triangles.astype(np.uint32))
    rays = np.concatenate(np.broadcast_arrays(origins, directions), axis=-1).astype(np.float32)
    hit = scene.cast_rays(o3d.core.Tensor(rays))
    reached = np.isfinite(hit["t_hit"].numpy())
    u, v = hit["primitive_uvs"].numpy()[reached].T
    corners = colours[triangles[hit["primitive_ids"].numpy()[reached]]].astype(np.float32)
    picture = np.tile(np.array(SKY, np.uint8), (*reached.shape, 1))
    mixed = np.einsum("pc,pcr->pr", np.stack([1.0 - u - v, u, v], axis=1), corners)
    picture[reached] = np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
    return picture


def _padded(picture: NDArray[np.uint8], height: int) -> NDArray[np.uint8]:
    """The picture centred on white of a given height."""
    missing = height - picture.shape[0]
    return np.pad(
        picture, ((missing // 2, missing - missing // 2), (0, 0), (0, 0)), constant_values=255
    )


if __name__ == "__main__":
    main()
