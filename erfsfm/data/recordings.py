"""Recordings to learn from: KITTI odometry roots (real or simulated), image folders and videos.

Discovery looks at folder names only; an image is decoded when a snippet asks for it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from erfsfm.config import Fidelity
from erfsfm.errors import DataError
from erfsfm.geometry.camera import Camera

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv")
CAMERAS = {"image_2": "P2", "image_3": "P3", "image_0": "P0", "image_1": "P1"}
IMAGE_FOLDERS = ("images", "image_2", "image_02", "image_0", "image_00", "rgb", "data")  # never a name of a drive


@dataclass(frozen=True)
class Recording:
    """Frames of one drive: ``images`` are files, or one video file whose frames are decoded together.

    ``camera`` belongs to the images as stored. ``depth`` and ``poses_file`` are truth, where it is known: poses
    of camera 0, which this camera sees at ``t_camera_cam0``. ``sequence`` is the name of its folder in an odometry
    root.
    """

    name: str
    images: tuple[Path, ...]
    camera: Camera
    video_frames: int = 0
    depth: tuple[Path, ...] | None = None
    poses_file: Path | None = None
    t_camera_cam0: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start: int = 0
    sequence: str = ""

    def __len__(self) -> int:
        return self.video_frames or len(self.images)

    @property
    def frames_name(self) -> str:
        """The name with its frames, as the leak record writes it: ``kitti_odometry/00[0:250]``."""
        return f"{self.name}[{self.start}:{self.start + len(self)}]"

    def part(self, start: int, stop: int) -> Recording:
        """Frames ``start`` to ``stop - 1``."""
        if self.video_frames:
            raise DataError(f"{self.images[0]} is a video: frame ranges need an image folder; extract it first")
        depth = self.depth[start:stop] if self.depth else None
        return replace(self, images=self.images[start:stop], depth=depth, start=self.start + start)

    @cached_property
    def _video(self) -> list[NDArray[np.uint8]]:
        return list(_decode_video(self.images[0]))

    def image(self, index: int, height: int, width: int) -> NDArray[np.uint8]:
        """Frame as ``(height, width, 3)`` uint8 RGB, resized without crop.

        Raises:
            DataError: the file is missing or not an image.
        """
        if self.video_frames:
            image = self._video[index]
        else:
            decoded = cv2.imread(str(self.images[index]), cv2.IMREAD_COLOR)
            if decoded is None:
                raise DataError(f"{self.images[index]} is missing or not a readable image; restore it or leave it out")
            image = decoded
        if image.shape[:2] != (self.camera.height, self.camera.width):
            raise DataError(
                f"{self.images[min(index, len(self.images) - 1)]} is {image.shape[1]} x {image.shape[0]}; the camera "
                f"of {self.name} is {self.camera.width} x {self.camera.height}; all images of a recording need one size"
            )
        return np.ascontiguousarray(resize_image(image, height, width)[..., ::-1])

    def true_depth(self, index: int) -> NDArray[np.float32] | None:
        """z-depth in metres ``(H, W)``, 0 where unknown; None where the recording has no depth."""
        if self.depth is None:
            return None
        encoded = cv2.imread(str(self.depth[index]), cv2.IMREAD_UNCHANGED)
        if encoded is None:
            raise DataError(f"{self.depth[index]} is missing or not a readable depth image")
        return np.asarray(encoded, dtype=np.float32) / np.float32(256)

    def true_poses(self, fidelity: Fidelity = "default") -> NDArray[np.float64] | None:
        """``T_world_camera`` ``(N, 4, 4)``, or None where the recording has no poses.

        Args:
            fidelity: ``paper`` gives the poses of camera 0, as the reference compares with.

        Raises:
            DataError: the file is malformed, or has fewer rows than there are frames.
        """
        if self.poses_file is None:
            return None
        try:
            rows = np.loadtxt(self.poses_file, ndmin=2).reshape(-1, 3, 4)
        except ValueError as error:
            raise DataError(f"{self.poses_file} must hold 12 numbers a row: {error}") from error
        rows = rows[self.start : self.start + len(self)]
        if len(rows) < len(self):
            raise DataError(f"{self.poses_file} ends before frame {self.start + len(self)} of {self.name}")
        T_world_camera = np.tile(np.eye(4), (len(rows), 1, 1))
        T_world_camera[:, :3] = rows
        if fidelity == "default":
            # the rectified cameras differ by a translation alone: t_cam0_camera = -t_camera_cam0
            T_world_camera[:, :3, 3] -= T_world_camera[:, :3, :3] @ np.array(self.t_camera_cam0)
        return T_world_camera


def resize_image(image: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """An image ``(H, W, 3)`` at ``height x width``, without crop: the one way in training and in inference."""
    if image.shape[:2] == (height, width):
        return image
    shrinks = image.shape[0] >= height and image.shape[1] >= width
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=method))


def discover(root: Path) -> list[Recording]:
    """All recordings under a root, two folders deep, sorted by name.

    Raises:
        DataError: nothing there to learn from.
    """
    if not root.exists():
        raise DataError(f"no data set at {root}: the path does not exist")
    found = _recordings_at(root)
    if not found and root.is_dir():
        visible = (p for p in root.iterdir() if not p.name.startswith("."))
        children = sorted(p for p in visible if p.is_dir() or p.suffix.lower() in VIDEO_SUFFIXES)
        found = [r for child in children for r in _recordings_at(child)]
    if not found:
        entries = sorted(p.name for p in root.iterdir())[:8] if root.is_dir() else [root.name]
        raise DataError(
            f"nothing to learn from in {root}: wanted a KITTI odometry root (sequences/NN/image_2), or images or a "
            f"video with camera.yaml; found {', '.join(entries) or 'an empty folder'}"
        )
    return found


def _recordings_at(root: Path) -> list[Recording]:
    for base in (root, root / "dataset"):
        if (base / "sequences").is_dir():
            return [r for s in sorted((base / "sequences").iterdir()) if s.is_dir() for r in _odometry(base, s)]
    if root.name == "sequences":
        return [r for s in sorted(root.iterdir()) if s.is_dir() for r in _odometry(root.parent, s)]
    folder = _folder(root)
    return [folder] if folder else []


def _odometry(base: Path, sequence: Path) -> list[Recording]:
    """The colour cameras of a sequence, else its grey ones."""
    present = [c for c in CAMERAS if (sequence / c).is_dir()]
    colour = [c for c in present if c in ("image_2", "image_3")]
    simulation = base / "simulation.json"
    name = f"simulated/{_seed(simulation)}" if simulation.is_file() else f"kitti_odometry/{sequence.name}"
    recordings = []
    for camera_folder in colour or present[:1]:
        images = image_files(sequence / camera_folder)
        if not images:
            raise DataError(f"{sequence / camera_folder} holds no png or jpg; download or extract the images")
        _require_numbered(images)
        depth = tuple(sorted((sequence / "depth_2").glob("*.png"))) if camera_folder == "image_2" else ()
        poses = base / "poses" / f"{sequence.name}.txt"
        camera, t_camera_cam0 = _odometry_camera(sequence / "calib.txt", CAMERAS[camera_folder], images[0])
        recordings.append(
            Recording(
                name,
                images,
                camera,
                depth=depth if len(depth) == len(images) else None,
                poses_file=poses if poses.is_file() else None,
                t_camera_cam0=t_camera_cam0,
                sequence=sequence.name,
            )
        )
    return recordings


def _seed(simulation: Path) -> int:
    try:
        return int(json.loads(simulation.read_text())["seed"])
    except (ValueError, TypeError, KeyError) as error:
        raise DataError(f"{simulation} must hold the simulation's seed; simulate again") from error


def _require_numbered(images: tuple[Path, ...]) -> None:
    """Frames 0, 1, 2, ...: a gap would be a jump to the networks, an offset a false leak record."""
    for index, image in enumerate(images):
        if not image.stem.isdecimal() or int(image.stem) != index:
            wanted = f"{index:0{len(images[0].stem)}d}"
            raise DataError(f"{image.parent} has no frame {wanted}: KITTI numbers from 0; found {image.name} there")


def _odometry_camera(calib: Path, row: str, image: Path) -> tuple[Camera, tuple[float, float, float]]:
    """A camera of the rig, and where camera 0 is seen from it: P = K [I | t_camera_cam0]."""
    if not calib.is_file():
        raise DataError(f"no calibration for {image.parent}: wanted {calib} with the row {row}")
    rows = dict(line.split(":", 1) for line in calib.read_text().splitlines() if ":" in line)
    try:
        P = np.array([float(v) for v in rows[row].split()]).reshape(3, 4)
    except (KeyError, ValueError) as error:
        raise DataError(f"{calib} has no valid row '{row}: 12 numbers'") from error
    if not (P[0, 0] > 0 and P[1, 1] > 0):
        raise DataError(f"{calib}: the focal lengths in row '{row}' must be positive")
    height, width = image_size(image)
    if not (width / 4 < P[0, 2] < 3 * width / 4 and height / 4 < P[1, 2] < 3 * height / 4):
        raise DataError(
            f"{calib}: the principal point ({P[0, 2]:g}, {P[1, 2]:g}) in row '{row}' is far from the middle of "
            f"{image.name}, {width} x {height}: calibration and images are of different sizes"
        )
    tx, ty, tz = np.linalg.solve(P[:, :3], P[:, 3])
    camera = Camera(width, height, float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2]))
    return camera, (float(tx), float(ty), float(tz))


def _folder(root: Path) -> Recording | None:
    """An image folder or a video with its camera.yaml, or None where there is neither."""
    is_video = root.is_file() and root.suffix.lower() in VIDEO_SUFFIXES
    home = root.parent if is_video else root
    if not (home / "camera.yaml").is_file():
        return None
    camera = _camera_file(home / "camera.yaml")
    place = home.absolute()
    name = f"folder/{place.parent.name if place.name in IMAGE_FOLDERS else place.name}"
    candidates = [home, *sorted(p for p in home.iterdir() if p.is_dir())] if home.is_dir() else []
    for candidate in [] if is_video else candidates:
        images = image_files(candidate)
        if images:
            return Recording(name, images, camera)
    videos = [root] if is_video else sorted(p for p in home.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES)
    if videos:
        return Recording(name, (videos[0],), camera, video_frames=sum(1 for _ in _decode_video(videos[0])))
    return None


def _camera_file(path: Path) -> Camera:
    try:
        content = yaml.safe_load(path.read_text())
        width, height = int(content["width"]), int(content["height"])
        camera = Camera(width, height, *(float(content[k]) for k in ("fx", "fy", "cx", "cy")))
    except (KeyError, TypeError, ValueError, yaml.YAMLError) as error:
        what = " ".join(str(error).split())
        raise DataError(f"{path} must give width, height, fx, fy, cx, cy as numbers; wrong is {what}") from error
    if not (camera.width > 0 and camera.height > 0 and camera.fx > 0 and camera.fy > 0):
        raise DataError(f"{path}: width, height, fx and fy must be positive")
    if content.get("model", "pinhole") == "fisheye" or any(content.get("distortion") or []):
        raise DataError(f"{path} describes a distorted camera: undistort the images before training")
    return camera


def _decode_video(path: Path) -> Iterator[NDArray[np.uint8]]:
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise DataError(f"{path} cannot be read as a video")
    while True:
        ok, image = capture.read()
        if not ok:
            return
        yield np.asarray(image, dtype=np.uint8)


def image_files(folder: Path) -> tuple[Path, ...]:
    """The images of a folder in natural order: ``2.png`` before ``10.png``."""
    images = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    return tuple(sorted(images, key=_natural_key))


def _natural_key(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]


def image_size(path: Path) -> tuple[int, int]:
    """Height and width of an image file."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise DataError(f"{path} is missing or not a readable image")
    return int(image.shape[0]), int(image.shape[1])
