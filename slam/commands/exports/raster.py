"""The map from above: the height and the colour of the topmost surface in each cell."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from slam.commands.exports.options import Origin
from slam.commands.exports.sampling import Grid, Samples, samples
from slam.formats.geotiff import local_projection, write_geotiff
from slam.formats.ply import Ply, rotated
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import RunError
from slam.runtime.imports import import_extra
from slam.runtime.storage.files import remove, write_atomically

RASTER = "raster.yaml"
GEOTIFFS = ("height.tif", "colour.tif")
RASTER_FILES = ("height.png", "colour.png", "height.pgw", "colour.pgw", *GEOTIFFS, RASTER)
_HEIGHT_STEPS = 65535  # of a 16-bit image; 0 is unknown
_FINEST_STEP = 0.001
_OPAQUE = 255


@dataclass(frozen=True)
class Raster:
    """Heights ``(H, W)`` float32, NaN where unknown, and RGB ``(H, W, 3)``; ``crs`` of a raster with north up."""

    grid: Grid
    heights: NDArray[np.float32]
    colours: NDArray[np.uint8]
    crs: str | None = None

    @property
    def known(self) -> NDArray[np.bool_]:
        """Cells with a surface ``(H, W)``."""
        return np.isfinite(self.heights)


def height_raster(mesh: Ply, resolution: float, origin: Origin | None) -> Raster:
    """Look at a mesh from above.

    Args:
        mesh: x right, y ahead, z up.
        resolution: side of a cell.
        origin: with it, x is east and y north of the first camera.

    Raises:
        SlamError: too many cells, or rasterio, which writes rasters with an origin, is not installed.
    """
    if origin is not None:
        import_extra("geotiff")
        mesh = rotated(mesh, _to_east_north(origin.heading_deg))
    grid = Grid.around(mesh.points, resolution)
    cells = grid.width * grid.height
    heights, colours = np.full(cells, -np.inf, np.float32), np.zeros((cells, 3), np.uint8)
    for part in samples(mesh, grid):
        _keep_topmost(grid, part, heights, colours)
    heights[np.isneginf(heights)] = np.nan
    raster = Raster(grid, heights.reshape(grid.shape), colours.reshape(*grid.shape, 3))
    return (
        raster if origin is None else replace(raster, crs=local_projection(origin.latitude_deg, origin.longitude_deg))
    )


def write_raster(output: Path, raster: Raster, unit: str) -> None:
    """Write ``height.png`` (16 bit), ``colour.png``, world files, GeoTIFFs with an origin, and ``raster.yaml`` last.

    Args:
        output: the folder; GeoTIFFs of a raster before go, files of other names stay.
        raster: what to write.
        unit: of its lengths, in words.

    Raises:
        SlamError: a file cannot be written.
    """
    grid, known = raster.grid, raster.known
    low, high = float(np.nanmin(raster.heights)), float(np.nanmax(raster.heights))
    offset = math.floor(low) - 1.0
    step = _FINEST_STEP
    while (high - offset) / step > _HEIGHT_STEPS - 1:
        step *= 10
    steps = np.where(known, np.rint((np.nan_to_num(raster.heights).astype(np.float64) - offset) / step), 0)
    write_png(output / "height.png", steps.astype(np.uint16))
    opacity = np.where(known, _OPAQUE, 0).astype(np.uint8)[..., None]
    write_png(output / "colour.png", np.concatenate([raster.colours[..., ::-1], opacity], axis=2))
    for name in ("height.pgw", "colour.pgw"):
        _write_text(output / name, _world_file(grid))
    if raster.crs is None:
        for name in GEOTIFFS:
            remove(output / name, RunError)
    else:
        corner = grid.x_min, grid.y_max
        write_geotiff(output / GEOTIFFS[0], raster.heights[None], corner, grid.resolution, raster.crs)
        bands = raster.colours.transpose(2, 0, 1)
        write_geotiff(output / GEOTIFFS[1], bands, corner, grid.resolution, raster.crs, known)
    description = {
        "width": grid.width,
        "height": grid.height,
        "resolution": grid.resolution,
        "axes": ["right", "ahead"] if raster.crs is None else ["east", "north"],
        "top_left": [grid.x_min, grid.y_max],
        "unit": unit,
        "heights": {"file": "height.png", "step": step, "offset": offset, "unknown": 0},
        "colours": {"file": "colour.png"},
    }
    description |= {} if raster.crs is None else {"crs": raster.crs}
    text = yaml.safe_dump(description, sort_keys=False, default_flow_style=None, width=200)
    _write_text(output / RASTER, text)


def write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write an image as OpenCV has it, BGR or of one channel; `RunError` where it cannot be written."""
    done, content = cv2.imencode(".png", image)
    if not done:
        raise RunError(f"{path}: cannot be encoded")
    write_atomically(path, lambda partial: partial.write_bytes(content.tobytes()), RunError)


def is_own_raster(folder: Path) -> bool:
    """Whether the raster in a folder is one that `write_raster` described."""
    path = folder / RASTER
    return path.is_file() and b"heights: {file: height.png" in path.read_bytes()


def _to_east_north(heading_deg: float) -> FloatArray:
    """Rotation ``(3, 3)`` from right, ahead, up to east, north, up."""
    c, s = math.cos(math.radians(heading_deg)), math.sin(math.radians(heading_deg))
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _keep_topmost(grid: Grid, part: Samples, heights: NDArray[np.float32], colours: NDArray[np.uint8]) -> None:
    """Enter the samples that are higher than what their cells hold."""
    cells, z = grid.cells(part.points), part.points[:, 2].astype(np.float32)
    order = np.lexsort((z, cells))
    last = np.append(np.flatnonzero(np.diff(cells[order])), len(order) - 1)
    top = order[last]
    top = top[z[top] > heights[cells[top]]]
    heights[cells[top]] = z[top]
    colours[cells[top]] = np.rint(part.colours[top])


def _world_file(grid: Grid) -> str:
    """The six numbers of a world file: pixel size, no rotation, centre of the top-left pixel."""
    half = 0.5 * grid.resolution
    numbers = (grid.resolution, 0.0, 0.0, -grid.resolution, grid.x_min + half, grid.y_max - half)
    return "".join(f"{number:.10g}\n" for number in numbers)


def _write_text(path: Path, text: str) -> None:
    write_atomically(path, lambda partial: partial.write_text(text, encoding="utf-8"), RunError)
