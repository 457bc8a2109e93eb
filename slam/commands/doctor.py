"""A check of the installation: parts that are installed, parts that are missing, and what to do about them."""

from __future__ import annotations

import importlib
import os
import platform
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path

from erfsfm.common.errors import OneLineError
from erfsfm.inference import record_of_whole_weights
from slam.runtime.errors import SlamError
from slam.runtime.imports import import_open3d
from slam.sequences.catalogue import KITTI_VARIABLE, open_sequence, sequence_kinds
from slam.sequences.poses import poses_beside

IMPORTED = {
    "numpy": "numpy",
    "gtsam": "gtsam",
    "kiss-icp": "kiss_icp.pybind.kiss_icp_pybind",
    "opencv-python-headless": "cv2",
    "onnxruntime": "onnxruntime",
}
LOOKED_UP = ("torch", "lightning", "evo")  # to import them takes up to five seconds
WEIGHTS = ("default", "sim", "erf-dfc", "erf-dfcv2")
# no fault
NO_DATA_SET = (
    f"missing  a data set: set ${KITTI_VARIABLE} or give --dataset "
    "(the simulated street needs none)"
)


def examine(dataset: Path | None, camera: Path | None = None) -> list[str]:
    """Check the installation and a data set, else ``$KITTI_ODOMETRY``; lines begin with ``ok`` or ``missing``."""
    lines = [f"ok       python {platform.python_version()} on {platform.machine()}"]
    reinstall = "; run make setup, or pip install --force-reinstall {}"
    lines += [
        _checked(name, partial(_package, name), reinstall.format(name))
        for name in (*LOOKED_UP, *IMPORTED)
    ]
    lines.append(_checked("open3d", lambda: f" {import_open3d().__version__}"))
    lines += [_checked(f"weights {name}", partial(_weights, name)) for name in WEIGHTS]
    variable = os.environ.get(KITTI_VARIABLE)
    root = dataset or (Path(variable) if variable else None)
    if root is None:
        no_camera = (
            [] if camera is None else [f"missing  the data set of camera {camera}: give --dataset"]
        )
        return [*lines, *no_camera, NO_DATA_SET]
    try:
        kinds = sequence_kinds(root)
    except SlamError as error:
        return [*lines, f"missing  {error}"]
    if not kinds:
        lines.append(f"missing  {root} is not a data set of a kind that docs/recordings.md lists")
    for name, kind in kinds.items():
        lines.append(
            _checked(f"sequence {name}", partial(_sequence, root, name, kind, camera), f" ({kind})")
        )
    return lines


def _checked(part: str, describe: Callable[[], str], advice: str = "") -> str:
    """A part with its description; or why it is missing, with an ``advice``."""
    try:
        return f"ok       {part}{describe()}"
    except (ImportError, OSError, OneLineError) as error:
        return f"missing  {part}: {error}{advice}"


def _package(name: str) -> str:
    if name in IMPORTED:
        importlib.import_module(IMPORTED[name])
    return f" {version(name)}"


def _weights(name: str) -> str:
    record = record_of_whole_weights(name)
    return f": {record.network.depth} and {record.network.pose}, {record.licence}"


def _sequence(root: Path, name: str, kind: str, camera: Path | None) -> str:
    sequence = open_sequence(root, name, camera)
    truth, beside = "true poses", poses_beside(root)
    if sequence.reference is None:
        truth = "no true poses" + ("" if beside is None else f" (--truth {beside} gives some)")
    height = (
        f"camera {sequence.camera_height_m:.2f} m high"
        if sequence.camera_height_m
        else "camera height unknown"
    )
    scans = sum(sequence.has_scan(k) for k in range(len(sequence)))
    size = f"{sequence.intrinsics.width}x{sequence.intrinsics.height}"
    return f": {len(sequence)} frames of {size}, {truth}, {height}, {scans} LiDAR scans ({kind})"
