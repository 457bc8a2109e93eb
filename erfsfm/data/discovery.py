"""Recordings under a root: KITTI odometry (real or simulated), KITTI raw, images, videos, prepared folders.

Discovery reads folder names and the first image of each recording, and counts the frames of videos. A recording
with missing frame numbers is split there, so that no snippet spans a gap in time.
"""

from __future__ import annotations

from pathlib import Path

from erfsfm.common.errors import DataError
from erfsfm.common.readers.camera_file import CAMERA_FILE, read_camera_file
from erfsfm.common.readers.images import first_size, image_folder, list_images, recording_name
from erfsfm.common.readers.kitti import (
    CAM_TO_CAM,
    ODOMETRY_CALIBRATION,
    ODOMETRY_CAMERAS,
    RAW_CAMERAS,
    CalibrationFile,
    OdometryRoot,
    drive_name,
    find_drives,
    find_odometry_root,
)
from erfsfm.common.readers.numbering import by_name, by_number
from erfsfm.common.readers.video import VIDEO_SUFFIXES, list_videos, video_name
from erfsfm.data.prepared import INDEX_FILE, read_prepared
from erfsfm.data.recordings import Recording, split_at_gaps
from erfsfm.data.video import Video
from erfsfm.geometry.camera import Camera

INDOOR_HEIGHT_M = 0.4  # for rooms, whose depths in this unit are those of streets in camera heights: from 1 to 20
_COLOUR = (2, 3)


def discover(root: Path) -> list[Recording]:
    """All recordings under a root, two folders deep, sorted by name.

    Raises:
        DataError: no recording found.
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
            f"no recording in {root}: wanted a KITTI odometry root (sequences/NN/image_2), KITTI raw drives "
            f"(2011_09_26/..._sync/image_02), images or a video with camera.yaml, or a prepared folder "
            f"({INDEX_FILE}); found "
            f"{entries or 'an empty folder'}"
        )
    return found


def _recordings_at(root: Path) -> list[Recording]:
    if (root / INDEX_FILE).is_file():
        return read_prepared(root)
    odometry = find_odometry_root(root)
    if odometry is not None:
        return [r for folder in sorted(odometry.folders()) for r in _odometry(odometry, folder)]
    drives = find_drives(root)
    if drives:
        return [recording for drive in drives.values() for recording in open_drive(drive)]
    return _own(root)


def _odometry(root: OdometryRoot, sequence: Path) -> list[Recording]:
    """The colour cameras of a sequence, else its grey ones, in parts without gaps."""
    present = [camera for camera in ODOMETRY_CAMERAS if (sequence / f"image_{camera}").is_dir()]
    poses = root.base / "poses" / f"{sequence.name}.txt"
    recordings = []
    for camera in [camera for camera in present if camera in _COLOUR] or present[:1]:
        folder = sequence / f"image_{camera}"
        images = list_images(folder)
        if not images:
            raise DataError(f"{folder} holds no png or jpg; download or extract the images")
        files = by_number(images)
        height, width = first_size(files.paths)
        calibration, row = CalibrationFile(sequence / ODOMETRY_CALIBRATION), f"P{camera}"
        pinhole = calibration.pinhole(row, width, height)
        tx, ty, tz = (float(value) for value in calibration.T_camera_cam0(row)[:3, 3])
        whole = Recording(
            root.recording_name(sequence.name),
            files.paths,
            Camera.of(pinhole),
            depth=_depth(sequence, files.paths) if camera == ODOMETRY_CAMERAS[0] else None,
            poses_file=poses if poses.is_file() else None,
            camera_height_m=_simulated_height(root),
            t_camera_cam0=(tx, ty, tz),
            sequence=sequence.name,
        )
        recordings += split_at_gaps(whole, files)
    return recordings


def _simulated_height(root: OdometryRoot) -> float | None:
    """The camera's height in a simulated world, in rooms `INDOOR_HEIGHT_M`; None in a real root."""
    file = root.base / CAMERA_FILE
    simulated = root.simulation_seed() is not None and file.is_file()
    return read_camera_file(file).height_or(None) or INDOOR_HEIGHT_M if simulated else None


def open_drive(drive: Path) -> list[Recording]:
    """Its colour cameras, else the first of its grey ones, in parts without gaps; none where it has no images.

    Raises:
        DataError: calibration is missing, or the images are of another shape than the camera.
    """
    drive = drive.absolute()
    images = {camera: list_images(drive / f"image_{camera}" / "data") for camera in RAW_CAMERAS}
    present = [camera for camera in RAW_CAMERAS if images[camera]]
    oxts = drive / "oxts" / "data"
    recordings = []
    for camera in [camera for camera in present if int(camera) in _COLOUR] or present[:1]:
        files = by_number(images[camera])
        height, width = first_size(files.paths)
        calibration = CalibrationFile(drive.parent / CAM_TO_CAM)
        whole = Recording(
            f"kitti_raw/{drive_name(drive.name)}",
            files.paths,
            Camera.of(calibration.rectified_pinhole(camera, width, height)),
            oxts=oxts if oxts.is_dir() else None,
        )
        recordings += split_at_gaps(whole, files)
    return recordings


def _depth(sequence: Path, images: tuple[Path, ...]) -> tuple[Path, ...] | None:
    """The depth maps of the images; None where one of them has none."""
    maps = tuple(sequence / "depth_2" / f"{image.stem}.png" for image in images)
    return maps if all(path.is_file() for path in maps) else None


def _own(root: Path) -> list[Recording]:
    """A user's images or videos with their camera.yaml; empty where there is neither."""
    is_video = root.is_file() and root.suffix.lower() in VIDEO_SUFFIXES
    home = root.parent if is_video else root
    if not (home / CAMERA_FILE).is_file():
        return []
    camera = _camera(home / CAMERA_FILE)
    images = [] if is_video else _images(home)
    if images:
        files = by_name(images)
        depth = tuple(home / "depth" / f"{path.stem}.png" for path in files.paths)
        exact = all(path.is_file() for path in depth)  # as a depth camera measures it
        height_m = read_camera_file(home / CAMERA_FILE).height_or(None) or INDOOR_HEIGHT_M
        name = f"folder/{recording_name(home)}"
        return split_at_gaps(
            Recording(
                name, files.paths, camera, depth=depth if exact else None, camera_height_m=height_m if exact else None
            ),
            files,
        )
    videos = [Video(file) for file in ([root] if is_video else list_videos(home))]
    return [Recording(f"folder/{video_name(v.path)}", (v.path,) * len(v), camera, v) for v in videos]


def _images(home: Path) -> list[Path]:
    """The images of a folder, or those of its one sub-folder of a usual name, or of the first that has any."""
    usual = image_folder(home)
    folders = [usual] if usual is not None else sorted(path for path in home.iterdir() if path.is_dir())
    return next((images for folder in folders if (images := list_images(folder))), [])


def _camera(path: Path) -> Camera:
    camera = read_camera_file(path)
    if camera.is_distorted:
        raise DataError(f"{path} describes a distorted camera: undistort the images before training")
    return Camera.of(camera.pinhole)
