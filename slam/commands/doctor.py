"""A check of the installation: parts that are installed, parts that are missing, and what to do about them."""

from __future__ import annotations

import importlib
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from erfsfm.common.errors import ErfsfmError
from erfsfm.inference import DepthPosePredictor
from slam.runtime.errors import SlamError
from slam.runtime.imports import import_open3d
from slam.sequences.catalogue import KITTI_VARIABLE, open_sequence, sequence_kinds

PACKAGES = ("torch", "numpy", "gtsam", "kiss_icp", "evo", "cv2", "onnxruntime", "lightning")
DISTRIBUTIONS = {"kiss_icp": "kiss-icp", "cv2": "opencv-python-headless"}
WEIGHTS = ("default", "sim", "erf-dfc", "erf-dfcv2")


def examine(dataset: Path | None, camera: Path | None = None) -> list[str]:
    """Check the installation; one line for each finding, each starting with ``ok`` or ``missing``.

    Args:
        dataset: a data set to check; None for ``$KITTI_ODOMETRY``, if it is set.
        camera: a ``camera.yaml`` in place of its own, or ``fov=DEGREES``.
    """
    lines = [f"ok       python {platform.python_version()} on {platform.machine()}"]
    lines += [_package(name) for name in PACKAGES]
    lines.append(_open3d())
    lines += [_weights(name) for name in WEIGHTS]
    variable = os.environ.get(KITTI_VARIABLE)
    root = dataset or (Path(variable) if variable else None)
    if root is None:
        lines.append(f"missing  a data set: set ${KITTI_VARIABLE} or give --dataset (the simulated street needs none)")
    else:
        lines += _dataset(root, camera)
    return lines


def _package(name: str) -> str:
    distribution = DISTRIBUTIONS.get(name, name)
    try:
        importlib.import_module(name)
        return f"ok       {distribution} {version(distribution)}"
    except (ImportError, OSError, PackageNotFoundError) as error:
        return f"missing  {distribution}: {error}; run make setup, or pip install {distribution}"


def _open3d() -> str:
    try:
        return f"ok       open3d {import_open3d().__version__}"
    except SlamError as error:
        return f"missing  {error}"


def _weights(name: str) -> str:
    try:
        record = DepthPosePredictor.from_weights(name).record
        return f"ok       weights {name}: {record.network.depth} and {record.network.pose}, {record.licence}"
    except ErfsfmError as error:
        return f"missing  weights {name}: {error}"


def _dataset(root: Path, camera: Path | None) -> list[str]:
    try:
        kinds = sequence_kinds(root)
    except SlamError as error:
        return [f"missing  {error}"]
    if not kinds:
        return [f"missing  {root} is not a data set of a kind that docs/recordings.md lists"]
    return [_sequence(root, name, kind, camera) for name, kind in kinds.items()]


def _sequence(root: Path, name: str, kind: str, camera: Path | None) -> str:
    try:
        sequence = open_sequence(root, name, camera)
    except SlamError as error:
        return f"missing  sequence {name}: {error} ({kind})"
    truth = "true poses" if sequence.reference is not None else "no true poses"
    height = f"camera {sequence.camera_height_m:.2f} m high" if sequence.camera_height_m else "camera height unknown"
    scans = sum(sequence.has_scan(k) for k in range(len(sequence)))
    size = f"{sequence.intrinsics.width}x{sequence.intrinsics.height}"
    return (
        f"ok       sequence {name}: {len(sequence)} frames of {size}, {truth}, {height}, {scans} LiDAR scans ({kind})"
    )
