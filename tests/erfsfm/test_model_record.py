"""The leak record from training to the evaluations that must refuse it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from erfsfm.common.errors import DataError
from erfsfm.config import ExperimentConfig
from erfsfm.evaluation.eigen import eigen_protocol
from erfsfm.evaluation.pose_protocols import pose_protocol
from erfsfm.inference import DepthPosePredictor
from erfsfm.model_record import read_record
from erfsfm.training.run import train

Small = dict[str, dict[str, Any]]


def trained(small: Small, root: Path, output: Path, **data: Any) -> DepthPosePredictor:
    tree = small | {
        "network": small["network"] | {"sources": 4},
        "data": small["data"] | {"roots": [str(root)]} | data,
        "training": small["training"] | {"steps": 1, "batch": 1},
    }
    return DepthPosePredictor.from_weights(
        train(ExperimentConfig.model_validate(tree), output, device="cpu")
    )


def test_a_raw_drive_leaks_into_its_odometry_sequence(
    tmp_path: Path, small: Small, write_raw: Callable[..., Path], write_root: Callable[..., Path]
):
    """2011_09_30_drive_0033 is sequence 09; the car stands in its frames 6 and 7, which are not recorded as seen."""
    write_raw(tmp_path / "raw", drive="2011_09_30_drive_0033", speeds=[9] * 6 + [0, 0] + [9] * 5)
    networks = trained(small, tmp_path / "raw", tmp_path / "run", exclude=[])
    record = read_record(tmp_path / "run" / "model.yaml")
    assert record.trained_on == [
        "kitti_raw/2011_09_30_drive_0033[0:6]",
        "kitti_raw/2011_09_30_drive_0033[8:13]",
    ]
    assert "CC BY-NC-SA" in record.licence
    root = write_root(tmp_path / "odometry", sequences=("09", "10"))
    with pytest.raises(
        DataError, match=r"leak: these weights were trained on kitti_odometry/09\[0:8\]"
    ):
        pose_protocol(networks, root, ["09"], "default", allow_leak=False)
    assert {
        row["leak"] for row in pose_protocol(networks, root, ["09"], "default", allow_leak=True)
    } == {True}
    assert {
        row["leak"] for row in pose_protocol(networks, root, ["10"], "default", allow_leak=False)
    } == {False}


def test_an_odometry_sequence_leaks_into_the_eigen_list(
    tmp_path: Path, small: Small, write_root: Callable[..., Path]
):
    """Sequence 00 is 2011_10_03_drive_0027, whose frame 0 is Eigen's: refused before an image is looked for."""
    networks = trained(small, write_root(tmp_path / "odometry"), tmp_path / "run")
    assert read_record(tmp_path / "run" / "model.yaml").trained_on == ["kitti_odometry/00[0:8]"]
    (tmp_path / "raw").mkdir()
    with pytest.raises(
        DataError, match=r"leak: .* kitti_raw/2011_10_03_drive_0027\[0:1\]; choose other weights"
    ):
        eigen_protocol(networks, tmp_path / "raw", "eigen", "default", allow_leak=False)
