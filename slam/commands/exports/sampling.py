"""A surface sampled evenly, and the cells of a grid that its samples fall into."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.formats.ply import Ply
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import RunError

_SPACING_CELLS = 0.7  # side of the largest sample over that of a cell
_MAX_SUBDIVISIONS = 512
_CHUNK_SAMPLES = 1_000_000
_MAX_CELLS = 64_000_000
_BORDER_DECIMALS = 6


@dataclass(frozen=True)
class Grid:
    """Square cells of the x-y plane; row 0 has the largest y."""

    x_min: float
    y_max: float
    width: int
    height: int
    resolution: float

    @classmethod
    def around(cls, points: FloatArray, resolution: float) -> Grid:
        """The cells that points ``(P, 3)`` lie in; their borders are multiples of ``resolution``.

        Raises:
            RunError: too many cells.
        """
        # rounded, so that an edge on a border of cells does not begin another row
        low = np.floor((points[:, :2].min(axis=0) / resolution).round(_BORDER_DECIMALS))
        high = np.ceil((points[:, :2].max(axis=0) / resolution).round(_BORDER_DECIMALS))
        high = np.maximum(high, low + 1)
        width, height = (high - low).tolist()
        if width * height > _MAX_CELLS:
            raise RunError(
                f"--resolution {resolution:g} gives {width:.0f} x {height:.0f} cells, more than {_MAX_CELLS:,}: "
                "give a larger one"
            )
        # the decimal nearest to the product, so that files say 12.3 and not 12.299999999999999
        x_min, y_max = float(low[0] * resolution), float(high[1] * resolution)
        return cls(round(x_min, 9), round(y_max, 9), int(width), int(height), resolution)

    @property
    def y_min(self) -> float:
        """The lower border."""
        return round(self.y_max - self.height * self.resolution, 9)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.height, self.width

    def cells(self, points: FloatArray) -> NDArray[np.int64]:
        """Flat numbers ``(P,)`` of the cells of points ``(P, 2 or 3)``."""
        column = np.floor((points[:, 0] - self.x_min) / self.resolution).astype(np.int64)
        row = np.floor((self.y_max - points[:, 1]) / self.resolution).astype(np.int64)
        return np.clip(row, 0, self.height - 1) * self.width + np.clip(column, 0, self.width - 1)

    def centres(self, cells: NDArray[np.int64]) -> FloatArray:
        """Centres ``(C, 2)`` of cells by their flat numbers."""
        row, column = np.divmod(cells, self.width)
        x = self.x_min + (column + 0.5) * self.resolution
        y = self.y_max - (row + 0.5) * self.resolution
        return np.stack([x, y], axis=1)


@dataclass(frozen=True)
class Samples:
    """Points of a surface ``(S, 3)`` and the area of each ``(S,)``."""

    points: FloatArray
    areas: FloatArray


def samples(mesh: Ply, grid: Grid) -> Iterator[Samples]:
    """The surface in equal parts of each triangle, so small that no cell is skipped."""
    assert mesh.triangles is not None
    points = mesh.points
    for start in range(0, len(mesh.triangles), _CHUNK_SAMPLES):
        yield from _samples(points[mesh.triangles[start : start + _CHUNK_SAMPLES]], grid)


def _samples(corners: FloatArray, grid: Grid) -> Iterator[Samples]:
    """Of triangles by the positions of their corners ``(T, 3, 3)``."""
    edges = corners - np.roll(corners, 1, axis=1)
    longest = np.sqrt((edges**2).sum(axis=2)).max(axis=1)
    areas = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    parts = np.ceil(longest / (_SPACING_CELLS * grid.resolution)).clip(1, _MAX_SUBDIVISIONS).astype(np.int64)
    for count in np.unique(parts).tolist():
        weights = _barycentric(count)  # (count**2, 3)
        triangles = np.flatnonzero(parts == count)
        step = max(1, _CHUNK_SAMPLES // len(weights))
        for start in range(0, len(triangles), step):
            chosen = triangles[start : start + step]
            yield Samples(
                (weights @ corners[chosen]).reshape(-1, 3),
                np.repeat(areas[chosen] / len(weights), len(weights)),
            )


def _barycentric(count: int) -> FloatArray:
    """Centres ``(count**2, 3)`` of the equal triangles that a triangle is cut into, ``count`` along each side."""
    i, j = (each.ravel() for each in np.mgrid[:count, :count])
    upright, inverted = i + j < count, i + j < count - 1
    first = np.concatenate([i[upright] + 1 / 3, i[inverted] + 2 / 3]) / count
    second = np.concatenate([j[upright] + 1 / 3, j[inverted] + 2 / 3]) / count
    return np.stack([first, second, 1 - first - second], axis=1)
