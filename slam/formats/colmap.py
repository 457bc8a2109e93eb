"""A run as a COLMAP model in text form: cameras.txt, images.txt, points3D.txt.

COLMAP writes ``T_camera_world``, quaternions wxyz, and puts (0.5, 0.5) at the centre of the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam.frames import Intrinsics
from slam.geometry.se3 import FloatArray, invert
from slam.runtime.errors import RunError
from slam.runtime.storage.files import write_atomically

MODEL_FILES = ("cameras.txt", "images.txt", "points3D.txt")
_HEADER = "# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY"
_HALF_PIXEL = 0.5


@dataclass(frozen=True)
class Sightings:
    """``frame`` ``(S,)`` sees at ``pixels`` ``(S, 2)`` the ``point`` ``(S,)``, up to ``errors_px`` ``(S,)``."""

    frame: NDArray[np.intp]
    pixels: FloatArray
    point: NDArray[np.intp]
    errors_px: FloatArray

    @classmethod
    def none(cls) -> Self:
        """Of points without tracks."""
        return cls(np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros(0))

    def of_frames(self) -> dict[int, NDArray[np.intp]]:
        """The sightings of each frame that has any."""
        order = np.argsort(self.frame, kind="stable")
        frames, first = np.unique(self.frame[order], return_index=True)
        return dict(zip(frames.tolist(), np.split(order, first[1:])))


def write_colmap(
    folder: Path,
    intrinsics: Intrinsics,
    T_world_camera: FloatArray,
    points_world: FloatArray,
    colours: NDArray[np.uint8],
    sightings: Sightings,
    without_image: Collection[int] = (),
) -> None:
    """Write the three files.

    Args:
        folder: made where missing; other files in it stay.
        intrinsics: the one camera.
        T_world_camera: poses ``(N, 4, 4)``; image k is ``<k>.png`` with six digits, as KITTI names it.
        points_world: ``(P, 3)``.
        colours: ``(P, 3)`` RGB.
        sightings: of points that have tracks.
        without_image: numbers of poses that have none, which are left out.

    Raises:
        RunError: a file cannot be written.
    """
    of_frames = {k: rows for k, rows in sightings.of_frames().items() if k not in without_image}
    images = _images(T_world_camera, without_image, sightings, of_frames)
    contents = _camera(intrinsics), images, _points(points_world, colours, sightings, of_frames)
    for name, lines in zip(MODEL_FILES, contents, strict=True):
        _write(folder / name, lines)


def is_own_model(folder: Path) -> bool:
    """Whether the model in a folder is one of `write_colmap`, whose comments are not COLMAP's."""
    path = folder / MODEL_FILES[0]
    return path.is_file() and path.read_bytes().startswith(_HEADER.encode())


def _write(path: Path, lines: Iterable[str]) -> None:
    def fill(partial: Path) -> None:
        with partial.open("w", encoding="ascii") as file:
            file.writelines(f"{line}\n" for line in lines)

    write_atomically(path, fill, RunError)


def _camera(camera: Intrinsics) -> list[str]:
    principal = [camera.cx + _HALF_PIXEL, camera.cy + _HALF_PIXEL]
    numbers = " ".join(map(repr, [float(value) for value in (camera.fx, camera.fy, *principal)]))
    return [_HEADER, f"1 PINHOLE {camera.width} {camera.height} {numbers}"]


def _images(
    T_world_camera: FloatArray,
    without_image: Collection[int],
    sightings: Sightings,
    of_frames: Mapping[int, NDArray[np.intp]],
) -> list[str]:
    T_camera_world = invert(T_world_camera)
    quaternions_xyzw = Rotation.from_matrix(T_camera_world[:, :3, :3]).as_quat(canonical=True)
    rows = np.concatenate([quaternions_xyzw[:, [3, 0, 1, 2]], T_camera_world[:, :3, 3]], axis=1)
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of X Y POINT3D_ID"]
    for k, row in enumerate(rows):
        if k not in without_image:
            seen = of_frames.get(k, np.zeros(0, np.intp))
            pixels = zip((sightings.pixels[seen] + _HALF_PIXEL).tolist(), sightings.point[seen].tolist())
            corners = " ".join(f"{x:.7g} {y:.7g} {point + 1}" for (x, y), point in pixels)
            lines += [f"{k + 1} {' '.join(map(repr, row.tolist()))} 1 {k:06d}.png", corners]
    return lines


def _points(
    points_world: FloatArray,
    colours: NDArray[np.uint8],
    sightings: Sightings,
    of_frames: Mapping[int, NDArray[np.intp]],
) -> Iterator[str]:
    yield "# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    tracks: dict[int, list[str]] = {}
    for frame, rows in of_frames.items():
        for corner, point in enumerate(sightings.point[rows].tolist()):
            tracks.setdefault(point, []).append(f"{frame + 1} {corner}")
    count = len(points_world)
    total = np.bincount(sightings.point, sightings.errors_px, count)
    errors = total / np.maximum(np.bincount(sightings.point, minlength=count), 1)
    for k, (point, colour, error) in enumerate(zip(points_world, colours, errors, strict=True)):
        place, shade = " ".join(f"{x:.9g}" for x in point.tolist()), " ".join(map(str, colour.tolist()))
        yield " ".join((f"{k + 1} {place} {shade} {error:.4g}", *tracks.get(k, ())))
