"""Poses of one sensor of KITTI's car from those of another; `common.readers.kitti_calibration` reads the files."""

from __future__ import annotations

from slam.geometry import se3
from slam.geometry.se3 import FloatArray


def moved_to_camera(T_any_cam0: FloatArray, T_camera_cam0: FloatArray) -> FloatArray:
    """Poses ``T_any_camera`` ``(N, 4, 4)`` of a camera that is rigidly mounted to camera 0."""
    T_any_camera: FloatArray = T_any_cam0 @ se3.invert(T_camera_cam0)
    return T_any_camera
