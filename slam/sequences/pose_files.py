"""True poses as one file a frame, 4 x 4 numbers each, as RGB-D data sets write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from erfsfm.common.files import read_text
from slam.geometry import se3
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import SequenceError

_ROTATION_TOLERANCE = 0.01  # 7-Scenes writes seven digits, ScanNet six


def read_pose_files(paths: list[Path]) -> FloatArray:
    """``T_any_camera`` ``(N, 4, 4)`` of files, NaN where one is missing or its numbers are not finite (tracking lost).

    Raises:
        SequenceError: a file holds other than 16 numbers, or no pose.
    """
    T_any_camera = np.full((len(paths), 4, 4), np.nan)
    for k, path in enumerate(paths):
        if not path.exists():
            continue
        try:
            pose = np.array(read_text(path).split(), dtype=np.float64).reshape(4, 4)
        except (OSError, ValueError) as error:
            raise SequenceError(f"{path} must hold the 4 x 4 numbers of a pose: {error}") from error
        if not np.isfinite(pose).all():
            continue
        if not se3.is_se3(pose, _ROTATION_TOLERANCE):
            raise SequenceError(f"{path} holds no pose: its 3 x 3 part is not a rotation")
        pose[:3, :3] = se3.nearest_rotation(pose[:3, :3])
        T_any_camera[k] = pose
    return T_any_camera
