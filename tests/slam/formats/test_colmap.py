"""A COLMAP model read back puts every point on the pixel where our camera sees it."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from slam.formats.colmap import Sightings, write_colmap
from slam.frames import Intrinsics
from slam.geometry.se3 import FloatArray, apply, chain, from_rotation_vector, invert

CAMERA = Intrinsics(416, 128, 230.5, 231.25, 207.0, 63.5)
POINTS = np.array([[1.0, 0.5, 12.0], [-3.0, 1.5, 20.0], [0.25, -2.0, 9.0]])
TEXTS = ("cameras.txt", "images.txt", "points3D.txt")
COLOURS = np.array([[1, 2, 3], [255, 0, 128], [7, 7, 7]], np.uint8)


def drive() -> FloatArray:
    turn = np.tile([0.01, 0.05, -0.02], (4, 1))
    return chain(from_rotation_vector(turn, np.tile([0.1, 0.0, 1.0], (4, 1))))


def rows(path: Path) -> list[list[str]]:
    """Lines without comments; an empty one stays, as images.txt needs it."""
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]


def lines_of(path: Path) -> list[list[float | str]]:
    """Its rows, numbers as numbers."""
    return [
        [word if word[0].isalpha() or "png" in word else float(word) for word in row]
        for row in rows(path)
    ]


def binary_rows(folder: Path) -> list[list[list[float | str]]]:
    """A model in COLMAP's binary form, as its documentation has it, as the rows of the text form."""
    cameras, images, points = (
        io.BytesIO((folder / f"{Path(name).stem}.bin").read_bytes()) for name in TEXTS
    )

    def take(file: io.BytesIO, form: str) -> tuple[float, ...]:
        return struct.unpack(f"<{form}", file.read(struct.calcsize(f"<{form}")))

    found: list[list[list[float | str]]] = [[], [], []]
    (count,), (number, model, *camera) = take(cameras, "Q"), take(cameras, "IiQQ4d")
    assert (count, model) == (1, 1)
    found[0].append([number, "PINHOLE", *camera])
    for _ in range(int(take(images, "Q")[0])):
        pose = take(images, "I7dI")
        name = b"".join(iter(lambda: images.read(1), b"\0")).decode()
        found[1].append([*pose, name])
        corners = [take(images, "ddQ") for _ in range(int(take(images, "Q")[0]))]
        found[1].append([value for corner in corners for value in corner])
    for _ in range(int(take(points, "Q")[0])):
        *point, length = take(points, "Q3d3BdQ")
        found[2].append([*point, *take(points, f"{2 * int(length)}I")])
    assert not any(file.read() for file in (cameras, images, points))
    return found


def test_a_model_reads_back(tmp_path: Path):
    pixels = np.array([[10.0, 20.0], [11.0, 21.0], [12.0, 22.0]])
    seen = Sightings(np.array([3, 0, 3]), pixels, np.array([1, 1, 0]), np.array([0.25, 0.75, 1.0]))
    write_colmap(tmp_path / "new" / "model", CAMERA, drive(), POINTS, COLOURS, seen)
    folder = tmp_path / "new" / "model"
    assert {path.name for path in folder.iterdir()} == {
        "cameras.txt",
        "images.txt",
        "points3D.txt",
        "sparse",
    }
    ((camera_id, model, width, height, *pinhole),) = rows(folder / "cameras.txt")
    assert (camera_id, model, width, height) == ("1", "PINHOLE", "416", "128")
    fx, fy, cx, cy = map(float, pinhole)
    lines = rows(folder / "points3D.txt")
    assert [line[7:] for line in lines] == [["1", "4", "1"], ["0.5", "1", "0", "4", "0"], ["-1"]]
    points = np.array([line[:7] for line in lines], dtype=float)
    np.testing.assert_array_equal(points[:, 0], [1, 2, 3])
    np.testing.assert_allclose(points[:, 1:4], POINTS, rtol=1e-5)
    np.testing.assert_array_equal(points[:, 4:7], COLOURS)
    images = rows(folder / "images.txt")
    corners = [["11.5", "21.5", "2"], [], [], ["10.5", "20.5", "2", "12.5", "22.5", "1"], []]
    assert images[1::2] == corners, "theirs are half a pixel more"
    for k, (image_id, *pose, camera, name) in enumerate(images[::2]):
        assert (image_id, camera, name) == (str(k + 1), "1", f"{k:06d}.png")
        numbers = np.array(pose, dtype=float)
        seen = Rotation.from_quat(numbers[[1, 2, 3, 0]]).apply(points[:, 1:4]) + numbers[4:]
        u, v = fx * seen[:, 0] / seen[:, 2] + cx, fy * seen[:, 1] / seen[:, 2] + cy
        ours = apply(invert(drive()[k]), POINTS) @ CAMERA.K.T
        # their pixel (0.5, 0.5) is our (0, 0)
        np.testing.assert_allclose(
            np.stack([u, v], axis=1) - 0.5, ours[:, :2] / ours[:, 2:], atol=1e-2
        )
    assert binary_rows(folder / "sparse" / "0") == [lines_of(folder / name) for name in TEXTS]
