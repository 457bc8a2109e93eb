"""Recordings under a root: KITTI odometry (real or simulated), KITTI raw, images, videos, prepared folders.

Discovery reads folder names and the first image of each recording, and counts the frames of videos. A recording
with missing frame numbers is split there, so that no snippet spans a gap in time.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from erfsfm.common.errors import DataError
from erfsfm.common.readers.camera_file import CAMERA_FILE, read_camera_file
from erfsfm.common.readers.frame_range import EVERYTHING, FrameRange
from erfsfm.common.readers.images import (
    first_size,
    has_images,
    image_folder,
    list_images,
    recording_folder,
)
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
from erfsfm.common.readers.numbering import NumberedFiles, by_name, by_number
from erfsfm.common.readers.video import VIDEO_SUFFIXES, list_videos, video_name
from erfsfm.data.prepared import INDEX_FILE, read_prepared
from erfsfm.data.recordings import Recording, Video, split_at_gaps
from erfsfm.geometry import Camera

INDOOR_HEIGHT_M = (
    0.4  # for rooms, whose depths in this unit are those of streets in camera heights: from 1 to 20
)
_COLOUR = (2, 3)
logger = logging.getLogger(__name__)
Number = TypeVar("Number", int, str)


def discover(root: Path, camera: Path | None = None) -> list[Recording]:
    """All recordings under a root, two folders deep, sorted by name; ``DataError`` where there is none.

    Args:
        root: a data set, a folder or a file.
        camera: the camera file of a user's images and videos, in place of those beside them.

    Raises:
        DataError: no recording found.
    """
    if not root.exists():
        raise DataError(f"no data set at {root}: the path does not exist")
    found = _recordings_at(root, camera)
    if not found and root.is_dir():
        for child in sorted(root.iterdir()):
            is_source = child.is_dir() or child.suffix.lower() in VIDEO_SUFFIXES
            if is_source and child.name[0] != ".":
                found += _recordings_at(child, camera)
    if not found:
        entries = (
            ", ".join(sorted(p.name for p in root.iterdir())[:8]) if root.is_dir() else root.name
        )
        raise DataError(
            f"no recording in {root}: wanted a KITTI odometry root (sequences/NN/image_2), KITTI raw drives "
            "(2011_09_26/..._sync/image_02), images or a video with camera.yaml (train --camera auto finds it), or a "
            f"prepared folder ({INDEX_FILE}); found {entries or 'an empty folder'}"
        )
    return found


def named_recordings(root: Path, name: str) -> list[Recording]:
    """Recordings of a sequence, or their part that a name with frames means (``00[250:300]``); of its first camera.

    Without a name they are all recordings of the root.

    Raises:
        DataError: no data there, no such sequence, or none of its frames.
        ConfigError: a name that is not written like that of frames.
    """
    if not name:
        return discover(root)
    found: dict[str, list[Recording]] = {}
    for each in discover(root):
        for known in {each.name, each.sequence or each.name}:
            found.setdefault(known, []).append(each)
    span = FrameRange(name, 0, EVERYTHING) if name in found else FrameRange.parse(name)
    if span.recording not in found:
        raise DataError(
            f"no sequence {span.recording} in {root}: found {', '.join(sorted(found)) or 'none'}"
        )
    camera = found[span.recording][0].images[0].parent
    known_frames: list[str] = []
    chosen: list[Recording] = []
    for whole in found[span.recording]:
        if whole.images[0].parent == camera:
            known_frames.append(whole.frames_name)
            part = whole.within(span.start, span.stop)
            chosen += [] if part is None else [part]
    if not chosen:
        raise DataError(f"{name} names no frame of a recording: found {', '.join(known_frames)}")
    return chosen


def _recordings_at(root: Path, camera: Path | None) -> list[Recording]:
    if (root / INDEX_FILE).is_file():
        return read_prepared(root)
    odometry = find_odometry_root(root)
    if odometry is not None:
        found = []
        for folder in sorted(odometry.folders()):
            found += _odometry(odometry, folder)
        return found
    if drives := find_drives(root):
        found = []
        for drive in drives.values():
            found += open_drive(drive)
        return found
    return _own(root, camera)


def _odometry(root: OdometryRoot, sequence: Path) -> list[Recording]:
    """The cameras of a sequence in parts without gaps."""
    folders: dict[int, Path] = {}
    for camera in ODOMETRY_CAMERAS:
        if (folder := sequence / f"image_{camera}").is_dir():
            folders[camera] = folder
    poses, written = root.base / "poses" / f"{sequence.name}.txt", root.base / CAMERA_FILE
    height_m: float | None = (
        None  # of the camera in a simulated world, in rooms a constant; unknown in a real root
    )
    if root.simulation_seed() is not None and written.is_file():
        height_m = read_camera_file(written).height_or(None) or INDOOR_HEIGHT_M
    recordings = []
    for camera, files, (height, width) in _cameras(folders):
        calibration, row = CalibrationFile(sequence / ODOMETRY_CALIBRATION), f"P{camera}"
        pinhole = calibration.pinhole(row, width, height)
        depth = tuple(sequence / "depth_2" / f"{image.stem}.png" for image in files.paths)
        tx, ty, tz = map(float, calibration.T_camera_cam0(row)[:3, 3])
        whole = Recording(
            root.recording_name(sequence.name),
            files.paths,
            Camera.of(pinhole),
            depth=depth
            if camera == ODOMETRY_CAMERAS[0] and all(map(Path.is_file, depth))
            else None,
            poses_file=poses if poses.is_file() else None,
            camera_height_m=height_m,
            t_camera_cam0=(tx, ty, tz),
            sequence=sequence.name,
        )
        recordings += split_at_gaps(whole, files)
    return recordings


def open_drive(drive: Path) -> list[Recording]:
    """The cameras of a raw drive in parts without gaps; none where it has no images."""
    drive = drive.absolute()
    oxts = drive / "oxts" / "data"
    folders: dict[str, Path] = {}
    for camera in RAW_CAMERAS:
        if has_images(folder := drive / f"image_{camera}" / "data"):
            folders[camera] = folder
    recordings = []
    for camera, files, (height, width) in _cameras(folders):
        calibration = CalibrationFile(drive.parent / CAM_TO_CAM)
        whole = Recording(
            f"kitti_raw/{drive_name(drive.name)}",
            files.paths,
            Camera.of(calibration.rectified_pinhole(camera, width, height)),
            oxts=oxts if oxts.is_dir() else None,
        )
        recordings += split_at_gaps(whole, files)
    return recordings


def _cameras(
    folders: dict[Number, Path],
) -> Iterator[tuple[Number, NumberedFiles, tuple[int, int]]]:
    """Images of the colour cameras, else of the first of the grey ones, with their height and width."""
    colour = [camera for camera in folders if int(camera) in _COLOUR]
    for camera in colour or list(folders)[:1]:
        images = list_images(folders[camera])
        if not images:
            raise DataError(
                f"{folders[camera]} holds no png or jpg; download or extract the images"
            )
        files = by_number(images)
        yield camera, files, first_size(files.paths)


def _own(root: Path, given: Path | None) -> list[Recording]:
    """A user's images or videos with the ``given`` camera file or their camera.yaml; empty where there is neither."""
    is_video = root.is_file() and root.suffix.lower() in VIDEO_SUFFIXES
    home = root.parent if is_video else root
    file = given or home / CAMERA_FILE
    if not (given or file.is_file()):
        return []
    written = read_camera_file(file)
    if written.is_distorted:
        raise DataError(
            f"{file} describes a distorted camera: undistort the images before training, as erfsfm-slam export RUN "
            "--what nerfstudio does"
        )
    camera = Camera.of(written.pinhole)
    mask = None if written.mask is None else Path(written.mask)
    folder = None if is_video else image_folder(home)
    images = [] if folder is None else list_images(folder)
    if not images:
        videos = map(Video, [root] if is_video else list_videos(home))
        return [
            Recording(f"folder/{video_name(v.path)}", (v.path,) * len(v), camera, v, mask=mask)
            for v in videos
        ]
    files = by_name(images)
    recording = recording_folder(home)
    whole = Recording(f"folder/{recording.name}", files.paths, camera, mask=mask)
    maps = recording / "depth"
    depth = tuple(maps / f"{path.stem}.png" for path in files.paths) if maps.is_dir() else ()
    missing = [path.name for path in depth if not path.is_file()]
    if depth and not missing:  # as a depth camera measures it
        if written.depth_per_metre is None:
            raise DataError(
                f"{file}: add depth_per_metre, the value of one metre in {maps}: 1000 in mm"
            )
        height_m = written.height_or(None) or INDOOR_HEIGHT_M
        whole = replace(
            whole, depth=depth, depth_per_metre=written.depth_per_metre, camera_height_m=height_m
        )
    elif len(missing) < len(depth):
        logger.warning(
            "%s is not used: it has no %s; move the images without depth away", maps, missing[0]
        )
    return split_at_gaps(whole, files)
