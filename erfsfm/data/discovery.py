"""What lies under a root: KITTI odometry (real or simulated), KITTI raw drives, image folders and videos.

Discovery looks at folder names only, and counts the frames of videos.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import yaml

from erfsfm.data.images import image_files, image_size, require_numbered
from erfsfm.data.kitti_raw import find_drives, open_drive
from erfsfm.data.recordings import Recording
from erfsfm.data.video import VIDEO_SUFFIXES, Video
from erfsfm.errors import DataError
from erfsfm.geometry.camera import Camera

CAMERAS = {"image_2": "P2", "image_3": "P3", "image_0": "P0", "image_1": "P1"}
IMAGE_FOLDERS = ("images", "image_2", "image_02", "image_0", "image_00", "rgb", "data")  # never a name of a drive


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
        entries = ", ".join(sorted(p.name for p in root.iterdir())[:8]) if root.is_dir() else root.name
        raise DataError(
            f"nothing to learn from in {root}: wanted a KITTI odometry root (sequences/NN/image_2), KITTI raw drives "
            f"(2011_09_26/..._sync/image_02), or images or a video with camera.yaml; found "
            f"{entries or 'an empty folder'}"
        )
    return found


def _recordings_at(root: Path) -> list[Recording]:
    for base in (root, root / "dataset"):
        if (base / "sequences").is_dir():
            return [r for s in sorted((base / "sequences").iterdir()) if s.is_dir() for r in _odometry(base, s)]
    if root.name == "sequences":
        return [r for s in sorted(root.iterdir()) if s.is_dir() for r in _odometry(root.parent, s)]
    drives = find_drives(root)
    if drives:
        return [recording for drive in drives for recording in open_drive(drive)]
    return _own(root)


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
        require_numbered(images)
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


def _own(root: Path) -> list[Recording]:
    """One's own images, or videos, with their camera.yaml; nothing where there is neither."""
    is_video = root.is_file() and root.suffix.lower() in VIDEO_SUFFIXES
    home = root.parent if is_video else root
    if not (home / "camera.yaml").is_file():
        return []
    camera = _camera_file(home / "camera.yaml")
    place = home.absolute()
    name = f"folder/{place.parent.name if place.name in IMAGE_FOLDERS else place.name}"
    candidates = [] if is_video else [home, *sorted(p for p in home.iterdir() if p.is_dir())]
    for candidate in candidates:
        images = image_files(candidate)
        if images:
            return [Recording(name, images, camera)]
    files = [root] if is_video else sorted(p for p in home.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES)
    videos = [Video(file) for file in files]
    return [Recording(name, (video.path,) * len(video), camera, video) for video in videos]


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
