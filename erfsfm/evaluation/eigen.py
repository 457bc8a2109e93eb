"""Depth on single frames of KITTI raw drives against LiDAR (Eigen et al. 2014), with both scales of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import zoom

from erfsfm.common.errors import DataError
from erfsfm.common.files import read_text
from erfsfm.common.readers.images import read_image, resize_image
from erfsfm.config import Fidelity
from erfsfm.data.split import read_split_file
from erfsfm.evaluation.depth_metrics import CAP_M, DepthErrors, depth_errors, mean_errors
from erfsfm.evaluation.protocols import refuse_leak
from erfsfm.evaluation.raw_drives import RawFrame, displacements, flat_road_depth, lidar_depth
from erfsfm.inference import DepthPosePredictor

_STILL_M = 0.1
_FLAT_ROAD_M = 20.0


def read_split(split: str, root: Path) -> list[RawFrame]:
    """The frames to test on of a shipped split or a YAML file (`erfsfm.data.split`), or those of a list.

    Args:
        split: ``eigen``, a file of the list ``test``, or any other file with a frame a line.
        root: of KITTI raw: the folder of the dates, a date, or a drive.
    """
    base = _root_of_dates(root)
    path = Path(split)
    if path.is_file() and path.suffix not in (".yaml", ".yml"):
        try:
            lines = read_text(path).splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise DataError(f"split {path} cannot be read: it is no text of a frame a line ({error})") from error
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
    frames = read_split(split, root)
    leak = refuse_leak(networks, [frame.name for frame in frames], allow_leak)
    errors: dict[str, list[DepthErrors]] = {"gt-median": [], "pose": []}
    flat: list[DepthErrors] = []
    for frame in frames:
        image = read_image(frame.image_path())
        truth = lidar_depth(frame, image.shape[:2], fidelity)
        guess = _depth(networks, image, fidelity)
        found = _compare(guess, truth, "median", fidelity)
        if found is None:
            raise DataError(f"the LiDAR of {frame.name} hits nothing under {CAP_M:g} m in the crop")
        errors["gt-median"].append(found)
        road = _compare(flat_road_depth(frame, image.shape[:2], _FLAT_ROAD_M), truth, "median", fidelity)
        flat += [road] if road is not None else []
        scale = _scale_of_motion(networks, frame, fidelity)
        by_motion = _compare(guess, truth, scale, fidelity) if scale is not None else None
        if by_motion is not None:
            errors["pose"].append(by_motion)
    rows = [_row("networks", scaling, found, len(frames), leak) for scaling, found in errors.items()]
    return [*rows, _row("flat road", "gt-median", flat, len(frames), leak=False)]


def _root_of_dates(root: Path) -> Path:
    """The folder of the dates, given it, a date or a drive."""
    if not root.is_dir():
        raise DataError(f"no data set at {root}: wanted the folder that holds KITTI's dates (2011_09_26, ...)")
    root = root.resolve()
    if root.name.endswith("_sync"):
        return root.parents[1]
    return root.parent if (root / "calib_cam_to_cam.txt").is_file() else root


def _depth(networks: DepthPosePredictor, image: NDArray[np.uint8], fidelity: Fidelity) -> NDArray[np.float32]:
    """Unscaled depth at the image's size."""
    if fidelity == "default":
        return networks.depth(image)
    size = networks.record.depth_input or networks.record.network
    depth = networks.depth(resize_image(image, size.height, size.width))
    height, width = image.shape[:2]
    return np.asarray(zoom(depth, (height / depth.shape[0], width / depth.shape[1]), order=3), dtype=np.float32)


def _compare(
    guess: NDArray[np.float32], truth: NDArray[np.float32], scaling: float | Any, fidelity: Fidelity
) -> DepthErrors | None:
    clipping: Any = "before" if fidelity == "paper" else "after"
    return depth_errors(guess, truth, CAP_M, crop="garg", scaling=scaling, clipping=clipping)


def _scale_of_motion(networks: DepthPosePredictor, frame: RawFrame, fidelity: Fidelity) -> float | None:
    """Mean of true over predicted distance to the sources; None for a still car, except in paper fidelity."""
    window = frame.window(networks.sources)
    true = displacements(frame, window)
    if fidelity == "default" and true.max() < _STILL_M:
        return None
    T_source_target = networks.poses([read_image(frame.image_path(index)) for index in window])
    predicted = np.linalg.norm(T_source_target[:, :3, 3], axis=1)
    return float(np.mean(true / np.maximum(predicted, 1e-12)))


def _row(method: str, scaling: str, errors: Sequence[DepthErrors], wanted: int, leak: bool) -> dict[str, Any]:
    row: dict[str, Any] = {"method": method, "scaling": scaling}
    if not errors:
        row |= {"abs_rel": None, "abs_rel_reason": "the car stands still in every frame"}
        return row | {"images": 0, "leak": leak}
    mean = asdict(mean_errors(list(errors)))
    row |= {key: value if np.isfinite(value) else None for key, value in mean.items()}
    row |= {f"{key}_reason": "an image has no scale" for key, value in mean.items() if not np.isfinite(value)}
    scales = np.array([error.scale for error in errors])
    row["scale_spread"] = float(scales.std() / scales.mean()) if scales.any() else None
    return row | {"images": len(errors), "left_out": wanted - len(errors), "leak": leak}
