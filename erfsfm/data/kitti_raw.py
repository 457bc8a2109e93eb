"""KITTI raw drives as training recordings; `erfsfm.common.readers.kitti_drives` describes their layout.

Images may be smaller than the original: the calibration follows them.
"""

from __future__ import annotations

from pathlib import Path

from erfsfm.common.readers.images import first_size, list_images
from erfsfm.common.readers.kitti_calibration import CAM_TO_CAM, CalibrationFile
from erfsfm.common.readers.kitti_drives import RAW_CAMERAS, drive_name
from erfsfm.common.readers.numbering import by_number
from erfsfm.data.recordings import Recording, split_at_gaps
from erfsfm.geometry.camera import Camera

_COLOUR = ("02", "03")


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
    for camera in [camera for camera in present if camera in _COLOUR] or present[:1]:
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
