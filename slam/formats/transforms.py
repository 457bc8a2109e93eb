"""``transforms.json``, the scene description of nerfstudio, which tools for NeRF and Gaussian splatting read.

Cameras have OpenGL's axes (x right, y up, z backwards), matrices are camera to world, and (0.5, 0.5) is the centre of
the top-left pixel.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from slam.frames import Intrinsics
from slam.geometry.se3 import FloatArray
from slam.runtime.errors import RunError
from slam.runtime.storage.files import write_atomically

TRANSFORMS = "transforms.json"
T_CAMERA_OPENGL: FloatArray = np.diag([1.0, -1.0, -1.0, 1.0])
_HALF_PIXEL = 0.5
_MADE_BY = {"made_by": "erfsfm-slam"}
MARK = json.dumps(_MADE_BY)[1:-1]


def write_transforms(
    path: Path, intrinsics: Intrinsics, T_world_camera: Mapping[str, FloatArray], points: str | None
) -> None:
    """Write the description, atomically.

    Args:
        path: ``transforms.json``.
        intrinsics: the one camera, without distortion.
        T_world_camera: poses ``(4, 4)`` by the names of their images.
        points: name of the PLY file of the cloud; None without.
    """
    frames = [
        {"file_path": name, "transform_matrix": (pose @ T_CAMERA_OPENGL).tolist()}
        for name, pose in T_world_camera.items()
    ]
    scene: dict[str, Any] = {
        **_MADE_BY,
        "camera_model": "OPENCV",
        "fl_x": float(intrinsics.fx),
        "fl_y": float(intrinsics.fy),
        "cx": float(intrinsics.cx) + _HALF_PIXEL,
        "cy": float(intrinsics.cy) + _HALF_PIXEL,
        "w": intrinsics.width,
        "h": intrinsics.height,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    }
    scene |= {} if points is None else {"ply_file_path": points}
    text = json.dumps(scene | {"frames": frames}, indent=2, allow_nan=False) + "\n"
    write_atomically(path, lambda file: file.write_text(text, encoding="utf-8"), RunError)
