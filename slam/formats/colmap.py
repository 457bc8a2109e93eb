"""A run as a COLMAP model, in text form and, for readers that know no other, in binary form in ``sparse/0``.

COLMAP writes ``T_camera_world``, quaternions wxyz, and puts (0.5, 0.5) at the centre of the top-left pixel.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.formats.trajectory import translations_and_quaternions
from slam.frames import Intrinsics
from slam.geometry.se3 import FloatArray, Rows, invert
from slam.runtime.errors import RunError
from slam.runtime.files import write_atomically

HEADER = "# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY"  # not in COLMAP's words
_HEADERS = {
    "cameras.txt": HEADER,
    "images.txt": "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of X Y POINT3D_ID",
    "points3D.txt": "# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)",
}
MODEL_FILES = tuple(_HEADERS)
BINARY_FOLDER = "sparse"
_PINHOLE = 1
_HALF_PIXEL = 0.5
_QUATERNION_WXYZ_FIRST = [6, 3, 4, 5, 0, 1, 2]  # of a translation and a quaternion xyzw


@dataclass(frozen=True)
class Sightings:
    """``frame`` ``(S,)`` sees at ``pixels`` ``(S, 2)`` the ``point`` ``(S,)``, up to ``errors_px`` ``(S,)``."""

    frame: Rows
    pixels: FloatArray
    point: Rows
    errors_px: FloatArray

    def of_frames(self) -> dict[int, Rows]:
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
    """
    of_frames = {k: rows for k, rows in sightings.of_frames().items() if k not in without_image}
    width, height = intrinsics.width, intrinsics.height
    centre = intrinsics.cx + _HALF_PIXEL, intrinsics.cy + _HALF_PIXEL
    pinhole = [float(value) for value in (intrinsics.fx, intrinsics.fy, *centre)]
    camera = f"1 PINHOLE {width} {height} {' '.join(map(repr, pinhole))}"
    packed_camera = struct.pack("<IiQQ4d", 1, _PINHOLE, width, height, *pinhole)
    rows = (
        [(camera, packed_camera)],
        _images(T_world_camera, without_image, sightings, of_frames),
        _points(points_world, colours, sightings, of_frames),
    )
    for (name, header), entries in zip(_HEADERS.items(), map(list, rows), strict=True):
        packed = struct.pack("<Q", len(entries)) + b"".join(binary for _, binary in entries)
        write_atomically(
            folder / BINARY_FOLDER / "0" / Path(name).with_suffix(".bin"), packed, RunError
        )
        lines = [header, *(text for text, _ in entries), ""]
        write_atomically(folder / name, "\n".join(lines), RunError)


def _images(
    T_world_camera: FloatArray,
    without_image: Collection[int],
    sightings: Sightings,
    of_frames: dict[int, Rows],
) -> Iterator[tuple[str, bytes]]:
    """Two lines an image, the second of its corners, and the same in binary form."""
    poses = translations_and_quaternions(invert(T_world_camera))[:, _QUATERNION_WXYZ_FIRST]
    for k, pose in enumerate(poses.tolist()):
        if k in without_image:
            continue
        seen, name = of_frames.get(k, np.zeros(0, np.intp)), f"{k:06d}.png"
        corners = np.empty(len(seen), [("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
        corners["x"], corners["y"] = sightings.pixels[seen].T + _HALF_PIXEL
        corners["point"] = sightings.point[seen] + 1
        text = " ".join(f"{x:.7g} {y:.7g} {point}" for x, y, point in corners.tolist())
        binary = struct.pack("<I7dI", k + 1, *pose, 1) + f"{name}\0".encode("ascii")
        binary += struct.pack("<Q", len(corners)) + corners.tobytes()
        yield f"{k + 1} {' '.join(map(repr, pose))} 1 {name}\n{text}", binary


def _points(
    points_world: FloatArray,
    colours: NDArray[np.uint8],
    sightings: Sightings,
    of_frames: dict[int, Rows],
) -> Iterator[tuple[str, bytes]]:
    """A line a point with its track: numbers of images, and of corners in them; and the same in binary form."""
    tracks: dict[int, list[tuple[int, int]]] = {}
    for frame, rows in of_frames.items():
        for corner, point in enumerate(sightings.point[rows].tolist()):
            tracks.setdefault(point, []).append((frame + 1, corner))
    count = len(points_world)
    total = np.bincount(sightings.point, sightings.errors_px, count)
    sightings_of = np.bincount(sightings.point, minlength=count)
    # a point without a track has COLMAP's -1
    errors = np.where(sightings_of > 0, total / np.maximum(sightings_of, 1), -1.0)
    for k, (place, colour, error) in enumerate(
        zip(points_world.tolist(), colours.tolist(), errors.tolist()), start=1
    ):
        track = tracks.get(k - 1, [])
        numbers = " ".join(f"{x:.9g}" for x in place), " ".join(map(str, colour)), f"{error:.4g}"
        text = " ".join((f"{k}", *numbers, *(f"{image} {corner}" for image, corner in track)))
        binary = struct.pack("<Q3d3BdQ", k, *place, *colour, error, len(track))
        yield text, binary + np.array(track, "<u4").tobytes()
