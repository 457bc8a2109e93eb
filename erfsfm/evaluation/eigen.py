"""Depth on single frames of KITTI raw drives against LiDAR (Eigen et al. 2014), with both scales of the paper.

Layout: ``ROOT/2011_09_26/2011_09_26_drive_0013_sync/{image_02,velodyne_points,oxts}/data``, calibration in the folder
of the date (`erfsfm.common.readers.kitti`). Images may be smaller than the original; the calibration follows.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom

from erfsfm.common.errors import DataError
from erfsfm.common.files import read_text
from erfsfm.common.readers.images import read_image, resize_image
from erfsfm.common.readers.kitti import (
    ASPECT_TOLERANCE,
    CAM_TO_CAM,
    CAMERA_HEIGHT_M,
    VELO_TO_CAM,
    CalibrationFile,
    FloatArray,
    read_velodyne,
    velocity,
)
from erfsfm.config import Fidelity
from erfsfm.data.split import read_split_file
from erfsfm.evaluation.depth_metrics import CAP_M, DepthErrors, depth_errors, mean_errors
from erfsfm.inference import DepthPosePredictor, refuse_leak

_STILL_M = 0.1
_FLAT_ROAD_M = 20.0
_FRAME = re.compile(
    r"(?:(?P<date>\d{4}_\d\d_\d\d)/)?(?P<drive>(?P<day>\d{4}_\d\d_\d\d)_drive_\d{4})(?:_sync)?"
    r"(?:/image_0(?P<camera>[23])/data/(?P<file>\d+)(?:\.\w+)?|\s+(?P<frame>\d+)(?:\s+(?P<side>[lr]))?)"
)


def read_split(split: str, root: Path) -> list[RawFrame]:
    """The frames to test on of a shipped split or a YAML file (`erfsfm.data.split`), or those of a list.

    Args:
        split: ``eigen``, a file of the list ``test``, or any other file with a frame a line.
        root: of KITTI raw: the folder of the dates, a date, or a drive.

    Raises:
        DataError: no data there, or a split that is missing, damaged or empty, or not of KITTI raw.
    """
    if not root.is_dir():
        raise DataError(
            f"no data set at {root}: wanted the folder that holds KITTI's dates (2011_09_26, ...)"
        )
    base = root.resolve()
    if base.name.endswith("_sync"):
        base = base.parents[1]
    elif (base / "calib_cam_to_cam.txt").is_file():
        base = base.parent
    path = Path(split)
    if path.is_file() and path.suffix not in (".yaml", ".yml"):
        try:
            lines = read_text(path).splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise DataError(
                f"split {path} cannot be read: it is no text of a frame a line ({error})"
            ) from error
        frames = [RawFrame.parse(line, base) for line in lines if line.strip()]
    else:
        frames = []
        for recording, index in read_split_file(split).test_frames():
            kind, _, drive = recording.partition("/")
            if kind != "kitti_raw":
                wanted = "kitti_raw/2011_09_26_drive_0002[0:64:3]"
                raise DataError(f"'{recording}' is no drive of KITTI raw: wanted {wanted}")
            frames.append(RawFrame.parse(f"{drive} {index}", base))
    if not frames:
        raise DataError(f"split {split} names no frames to test on")
    return frames


def eigen_protocol(
    networks: DepthPosePredictor, root: Path, split: str, fidelity: Fidelity, allow_leak: bool
) -> list[dict[str, Any]]:
    """Errors under 80 m in the crop of Garg et al., scaled by the medians and by the car's own speed.

    ============  ================================  ====================================
    .             paper                             default
    ============  ================================  ====================================
    to full size  cubic on depth                    bilinear on disparity
    clipping      before scaling, never after       after scaling
    still car     counts, its scale is near 0       left out of the row ``pose``
    ============  ================================  ====================================

    Returns:
        Rows ``gt-median`` and ``pose`` of the networks; ``pose`` multiplies depth by the mean over a window's sources
        of true over predicted distance. Then ``gt-median`` of a baseline that uses no image: a flat road, cut at 20 m.

    Raises:
        DataError: split, images, LiDAR or GPS/IMU missing or malformed, or a leak that was not allowed.
    """
    compare = partial(
        depth_errors,
        cap_m=CAP_M,
        crop="garg",
        clipping="before" if fidelity == "paper" else "after",
    )
    frames = read_split(split, root)
    leak = refuse_leak(networks, [frame.name for frame in frames], allow_leak)
    errors: dict[str, list[DepthErrors]] = {"gt-median": [], "pose": []}
    flat: list[DepthErrors] = []
    for frame in frames:
        image = read_image(frame.image_path())
        truth = lidar_depth(frame, image.shape[:2], fidelity)
        if fidelity == "default":
            guess = networks.depth(image)
        else:
            size = networks.record.depth_input or networks.record.network
            small = networks.depth(resize_image(image, size.height, size.width))
            factors = (image.shape[0] / small.shape[0], image.shape[1] / small.shape[1])
            guess = np.asarray(zoom(small, factors, order=3), dtype=np.float32)
        found = compare(guess, truth)
        if found is None:
            raise DataError(f"the LiDAR of {frame.name} hits nothing under {CAP_M:g} m in the crop")
        errors["gt-median"].append(found)
        road = compare(flat_road_depth(frame, image.shape[:2], _FLAT_ROAD_M), truth)
        flat += [road] if road is not None else []
        scale = _scale_of_motion(networks, frame, fidelity)
        by_motion = compare(guess, truth, scaling=scale) if scale is not None else None
        if by_motion is not None:
            errors["pose"].append(by_motion)
    rows = [_row("networks", *compared, len(frames), leak) for compared in errors.items()]
    return [*rows, _row("flat road", "gt-median", flat, len(frames), leak=False)]


def _scale_of_motion(
    networks: DepthPosePredictor, frame: RawFrame, fidelity: Fidelity
) -> float | None:
    """Mean of true over predicted distance to the sources; None for a still car, except in paper fidelity."""
    window = frame.window(networks.sources)
    true = displacements(frame, window)
    if fidelity == "default" and true.max() < _STILL_M:
        return None
    T_source_target = networks.poses([read_image(frame.image_path(index)) for index in window])
    predicted = np.linalg.norm(T_source_target[:, :3, 3], axis=1)
    return float(np.mean(true / np.maximum(predicted, 1e-12)))


def _row(
    method: str, scaling: str, errors: Sequence[DepthErrors], wanted: int, leak: bool
) -> dict[str, Any]:
    row: dict[str, Any] = {"method": method, "scaling": scaling}
    if not errors:
        row |= {"abs_rel": None, "abs_rel_reason": "the car stands still in every frame"}
        return row | {"images": 0, "leak": leak}
    mean = asdict(mean_errors(list(errors)))
    without = [key for key, value in mean.items() if not np.isfinite(value)]
    row |= mean | dict.fromkeys(without)
    row |= {f"{key}_reason": "an image has no scale" for key in without}
    scales = np.array([error.scale for error in errors])
    row["scale_spread"] = float(scales.std() / scales.mean()) if scales.any() else None
    return row | {"images": len(errors), "left_out": wanted - len(errors), "leak": leak}


@dataclass(frozen=True)
class RawFrame:
    """One frame of a colour camera.

    Attributes:
        root: folder of the dates.
        drive: ``2011_09_26_drive_0013``.
        index: frame.
        camera: 2 is the left colour camera, 3 the right one.
    """

    root: Path
    drive: str
    index: int
    camera: int = 2

    @staticmethod
    def parse(line: str, root: Path) -> RawFrame:
        """Read a line of a split: an image's path, or ``drive frame`` with an optional ``l`` or ``r``.

        Raises:
            DataError: the line names no frame.
        """
        match = _FRAME.fullmatch(line.strip())
        if match is None:
            raise DataError(
                f"'{line.strip()}' names no frame: wanted the path of an image, or 2011_09_26_drive_0013 5"
            )
        camera = int(match["camera"] or (3 if match["side"] == "r" else 2))
        return RawFrame(root, match["drive"], int(match["file"] or match["frame"]), camera)

    @property
    def name(self) -> str:
        """As the leak record writes it: ``kitti_raw/2011_09_26_drive_0013[5:6]``."""
        return f"kitti_raw/{self.drive}[{self.index}:{self.index + 1}]"

    @property
    def folder(self) -> Path:
        """Of the drive."""
        return self.root / self.drive[:10] / f"{self.drive}_sync"

    def image_path(self, index: int | None = None) -> Path:
        """The image of a frame of this drive, its own if None: png or jpg, whichever there is.

        Raises:
            DataError: the image is missing.
        """
        stem = (
            self.folder
            / f"image_0{self.camera}"
            / "data"
            / f"{self.index if index is None else index:010d}"
        )
        for suffix in (".png", ".jpg"):
            if stem.with_suffix(suffix).is_file():
                return stem.with_suffix(suffix)
        raise DataError(
            f"{stem}.png (or .jpg) is missing: download the drive, or take the frame out of the split"
        )

    def window(self, sources: int) -> list[int]:
        """The frame with ``sources`` others around it, shifted where the drive begins or ends.

        Raises:
            DataError: the drive has too few images.
        """
        folder = self.folder / f"image_0{self.camera}" / "data"
        count = (
            sum(1 for path in folder.iterdir() if path.suffix in (".png", ".jpg"))
            if folder.is_dir()
            else 0
        )
        half = sources // 2
        if count < sources + 1:
            raise DataError(
                f"{self.drive} has {count} images; its poses need windows of {sources + 1}"
            )
        middle = min(max(self.index, half), count - half - 1)
        return list(range(middle - half, middle + half + 1))


def lidar_depth(
    frame: RawFrame, size: tuple[int, int], fidelity: Fidelity = "default"
) -> NDArray[np.float32]:
    """z-depth of the LiDAR's points in the image of a frame, the nearest where several fall on one pixel.

    z [u v 1]^T = P_rect R_rect_00 T_cam_velo X; the pixel is round(u) - 1, the benchmark's counting from one

    Args:
        frame: which.
        size: (height, width) of its image as stored.
        fidelity: ``paper`` also takes the nearest of the last pixel of a row and the first of the next, which the
            reference's numbering confuses.

    Returns:
        Metres ``(H, W)``, 0 where there is no point.

    Raises:
        DataError: scan or calibration is missing or malformed, or the image has another shape than the camera.
    """
    height, width = size
    date, path = (
        frame.folder.parent,
        frame.folder / "velodyne_points" / "data" / f"{frame.index:010d}.bin",
    )
    camera = CalibrationFile(date / CAM_TO_CAM)
    R_rect = np.eye(4)
    R_rect[:3, :3] = camera.matrix("R_rect_00", (3, 3))
    T_cam_velo = CalibrationFile(date / VELO_TO_CAM).transform("R", "T")
    to_pixels = _rectified_camera(camera, frame, size) @ R_rect @ T_cam_velo
    if not path.is_file():
        raise DataError(
            f"{path} is missing: the true depth of the split's frames comes from the LiDAR"
        )
    points = read_velodyne(path)
    points = points[points[:, 0] >= 0]
    projected = points @ to_pixels[:, :3].T + to_pixels[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        places = np.round(projected[:, :2] / projected[:, 2:]) - 1
    z = projected[:, 2]
    inside = (places >= 0).all(axis=1) & (places[:, 0] < width) & (places[:, 1] < height)
    columns, rows = places[inside].astype(np.int64).T
    depth = _nearest(rows, columns, z[inside], size, fidelity)
    return np.maximum(depth, 0).astype(np.float32)


def displacements(frame: RawFrame, window: list[int]) -> FloatArray:
    """Distances in metres ``(N,)`` from a window's middle frame to the others, by the velocity of its GPS/IMU.

    Trapezoids over (north, east, up) velocities, as the reference does; ``window`` are consecutive frame numbers.

    Raises:
        DataError: a file is missing or malformed.
    """
    folder = frame.folder / "oxts"
    path = folder / "timestamps.txt"
    if not path.is_file():
        raise DataError(f"{path} is missing: how far the car moved needs a date and a time a frame")
    stamps = path.read_text().split("\n")
    try:
        times = np.array([stamps[i].strip() or "nothing" for i in window], "datetime64[ns]")
    except (ValueError, IndexError) as error:
        raise DataError(
            f"{path} must hold a date and a time a frame: {' '.join(str(error).split())}"
        ) from error
    seconds = (times - times[0]) / np.timedelta64(1, "s")
    speeds = np.stack([velocity(folder / "data", i) for i in window])
    steps = 0.5 * (speeds[:-1] + speeds[1:]) * np.diff(seconds)[:, None]
    places = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    middle = len(window) // 2
    distances: FloatArray = np.linalg.norm(places - places[middle], axis=1)
    return np.delete(distances, middle)


def _nearest(
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    z: FloatArray,
    size: tuple[int, int],
    fidelity: Fidelity,
) -> FloatArray:
    if fidelity == "default":
        depth = np.full(size, np.inf)
        np.minimum.at(depth, (rows, columns), z)
        return np.where(np.isfinite(depth), depth, 0)
    depth = np.zeros(size)
    depth[rows, columns] = z
    # the reference numbers pixels row by row with one too few a row; of each number the first place gets the nearest
    _, first, group, counts = np.unique(
        rows * (size[1] - 1) + columns, return_index=True, return_inverse=True, return_counts=True
    )
    nearest = np.full(len(first), np.inf)
    np.minimum.at(nearest, group, z)
    shared = first[counts > 1]
    depth[rows[shared], columns[shared]] = nearest[counts > 1]
    return depth


def flat_road_depth(
    frame: RawFrame, size: tuple[int, int], farthest_m: float
) -> NDArray[np.float32]:
    """z-depth in metres ``(H, W)`` of a flat road under a level camera, and ``farthest_m`` where that is farther."""
    camera = _rectified_camera(CalibrationFile(frame.folder.parent / CAM_TO_CAM), frame, size)
    below_horizon = np.arange(1, size[0] + 1) - camera[1, 2]
    depth = camera[1, 1] * CAMERA_HEIGHT_M / np.maximum(below_horizon, 1e-9)
    return np.repeat(np.minimum(depth, farthest_m).astype(np.float32)[:, None], size[1], axis=1)


def _rectified_camera(
    camera: CalibrationFile, frame: RawFrame, size: tuple[int, int]
) -> FloatArray:
    """Points of the rectified camera 0 to pixels that count from one, ``(3, 4)``, at the image's size."""
    date = frame.folder.parent
    full_width, full_height = camera.matrix(f"S_rect_0{frame.camera}", (2,))
    P_rect = camera.matrix(f"P_rect_0{frame.camera}", (3, 4))
    scale_y, scale_x = size[0] / full_height, size[1] / full_width
    if abs(scale_x / scale_y - 1) > ASPECT_TOLERANCE:
        raise DataError(
            f"{frame.image_path()} is cropped, or of another camera than that in {date}"
        )
    # half a pixel stays half a pixel when pixels grow: u' = (u - 1/2) s + 1/2, counting from one
    resize = np.array([[scale_x, 0, (1 - scale_x) / 2], [0, scale_y, (1 - scale_y) / 2], [0, 0, 1]])
    rectified: FloatArray = resize @ P_rect
    return rectified
