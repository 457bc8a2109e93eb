"""The files of a simulated KITTI odometry root: images, depth maps, calibration and poses."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.simulation.geometry import Float32Array, FloatArray


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """An RGB image ``(H, W, 3)`` as PNG."""
    _write_png(path, image[..., ::-1])


def write_depth(path: Path, depth: Float32Array) -> None:
    """A depth map in metres ``(H, W)`` as 16-bit PNG, metres x 256."""
    _write_png(path, np.clip(np.rint(depth * 256.0), 0.0, 65535.0).astype(np.uint16))


def write_calibration(path: Path, K: FloatArray, T_camera_lidar: FloatArray) -> None:
    """``calib.txt``: the one camera stands for all four."""
    projection = _row(np.column_stack([K, np.zeros(3)]))
    rows = [f"P{camera}: {projection}" for camera in range(4)]
    write_lines(path, [*rows, f"Tr: {_row(T_camera_lidar[:3])}"])


def write_poses(path: Path, T_world_camera: FloatArray) -> None:
    """Twelve numbers a row for poses ``(N, 4, 4)``."""
    write_lines(path, [_row(T[:3]) for T in T_world_camera])


def write_lines(path: Path, lines: list[str]) -> None:
    """A text file."""
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_png(path: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    _, content = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    path.write_bytes(content.tobytes())  # OpenCV's writer does not say why it fails


def _row(matrix: FloatArray) -> str:
    return " ".join(f"{value:.9e}" for value in matrix.ravel())
