"""A run as a COLMAP model, in text form and, for readers that know no other, in binary form in ``sparse/0``.

COLMAP writes ``T_camera_world``, quaternions wxyz, and puts (0.5, 0.5) at the centre of the top-left pixel.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Iterator
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
BINARY_FOLDER = "sparse"
_PINHOLE = 1
_HEADER = "# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY"
_HALF_PIXEL = 0.5

View = tuple[int, list[float], FloatArray, NDArray[np.intp]]
"""Frame, quaternion wxyz and translation of ``T_camera_world``, corners ``(S, 2)`` in COLMAP's pixels, their points."""
Point = tuple[list[float], list[int], float, list[tuple[int, int]]]
"""Position, colour, mean error in pixels, and the track: numbers of images, and of corners in them."""


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
    """Write the three files in both forms.

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
    views = list(_views(T_world_camera, without_image, sightings, of_frames))
    points = list(_points(points_world, colours, sightings, of_frames))
    width, height = intrinsics.width, intrinsics.height
    pinhole = [
        float(v) for v in (intrinsics.fx, intrinsics.fy, intrinsics.cx + _HALF_PIXEL, intrinsics.cy + _HALF_PIXEL)
    ]
    camera = [_HEADER, f"1 PINHOLE {width} {height} {' '.join(map(repr, pinhole))}"]
    text = camera, _views_text(views), _points_text(points)
    packed = struct.pack("<QIiQQ4d", 1, 1, _PINHOLE, width, height, *pinhole)
    binary = [packed], _views_binary(views), _points_binary(points)
    for name, lines, parts in zip(MODEL_FILES, text, binary, strict=True):
        _write(folder / BINARY_FOLDER / "0" / Path(name).with_suffix(".bin"), parts)
        _write(folder / name, (f"{line}\n".encode("ascii") for line in lines))


def is_own_model(folder: Path) -> bool:
    """Whether the model in a folder is one of `write_colmap`, whose comments are not COLMAP's."""
    path = folder / MODEL_FILES[0]
    return path.is_file() and path.read_bytes().startswith(_HEADER.encode())


def _write(path: Path, parts: Iterable[bytes]) -> None:
    def fill(partial: Path) -> None:
        with partial.open("wb") as file:
            file.writelines(parts)

    write_atomically(path, fill, RunError)


def _views(
    T_world_camera: FloatArray,
    without_image: Collection[int],
    sightings: Sightings,
    of_frames: dict[int, NDArray[np.intp]],
) -> Iterator[View]:
    T_camera_world = invert(T_world_camera)
    quaternions_xyzw = Rotation.from_matrix(T_camera_world[:, :3, :3]).as_quat(canonical=True)
    rows = np.concatenate([quaternions_xyzw[:, [3, 0, 1, 2]], T_camera_world[:, :3, 3]], axis=1)
    for k, row in enumerate(rows.tolist()):
        if k not in without_image:
            seen = of_frames.get(k, np.zeros(0, np.intp))
            yield k, row, sightings.pixels[seen] + _HALF_PIXEL, sightings.point[seen]


def _points(
    points_world: FloatArray,
    colours: NDArray[np.uint8],
    sightings: Sightings,
    of_frames: dict[int, NDArray[np.intp]],
) -> Iterator[Point]:
    tracks: dict[int, list[tuple[int, int]]] = {}
    for frame, rows in of_frames.items():
        for corner, point in enumerate(sightings.point[rows].tolist()):
            tracks.setdefault(point, []).append((frame + 1, corner))
    count = len(points_world)
    total = np.bincount(sightings.point, sightings.errors_px, count)
    errors = total / np.maximum(np.bincount(sightings.point, minlength=count), 1)
    columns = points_world.tolist(), colours.tolist(), errors.tolist()
    for k, (place, colour, error) in enumerate(zip(*columns, strict=True)):
        yield place, colour, error, tracks.get(k, [])


def _views_text(views: list[View]) -> Iterator[str]:
    yield "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of X Y POINT3D_ID"
    for k, pose, pixels, points in views:
        yield f"{k + 1} {' '.join(map(repr, pose))} 1 {k:06d}.png"
        corners = zip(pixels.tolist(), points.tolist())
        yield " ".join(f"{x:.7g} {y:.7g} {point + 1}" for (x, y), point in corners)


def _points_text(points: list[Point]) -> Iterator[str]:
    yield "# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    for k, (place, colour, error, track) in enumerate(points):
        numbers = " ".join(f"{x:.9g}" for x in place), " ".join(map(str, colour)), f"{error:.4g}"
        yield " ".join((f"{k + 1}", *numbers, *(f"{image} {corner}" for image, corner in track)))


def _views_binary(views: list[View]) -> Iterator[bytes]:
    yield struct.pack("<Q", len(views))
    for k, pose, pixels, points in views:
        yield struct.pack("<I7dI", k + 1, *pose, 1) + f"{k:06d}.png\0".encode("ascii")
        corners = np.empty(len(points), [("pixel", "<f8", 2), ("point", "<u8")])
        corners["pixel"], corners["point"] = pixels, points + 1
        yield struct.pack("<Q", len(corners)) + corners.tobytes()


def _points_binary(points: list[Point]) -> Iterator[bytes]:
    yield struct.pack("<Q", len(points))
    for k, (place, colour, error, track) in enumerate(points):
        yield struct.pack("<Q3d3BdQ", k + 1, *place, *colour, error, len(track)) + np.array(track, "<u4").tobytes()
