"""Depth errors over several streets: each counts alike, with a standard error by blocks of images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.common.errors import DataError
from erfsfm.evaluation.depth_metrics import block_error
from erfsfm.evaluation.protocols import depth_protocol


class Flat:
    """A depth of 3 everywhere."""

    sources = 4

    def depth(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        return np.full(image.shape[:2], 3.0, np.float32)

    def leaks(self, names: list[str]) -> list[str]:
        return [name for name in names if name.startswith("kitti_odometry/")]


def write_pairs(root: Path, street: str, farther: list[bool]) -> None:
    """Images with four known depths: 10 m, and one of 20 m where ``farther``, which makes an AbsRel of 0.125."""
    for folder in ("images", "truth"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    for index, with_far in enumerate(farther):
        cv2.imwrite(str(root / "images" / f"{street}_{index:06d}.jpg"), np.zeros((64, 96, 3), np.uint8))
        truth = np.zeros((64, 96), np.uint16)
        truth[[40, 40, 50, 50], [40, 50, 40, 50]] = 2560
        truth[50, 50] *= 1 + with_far
        truth[2, 2] = 60 * 256  # outside the crop
        cv2.imwrite(str(root / "truth" / f"{street}_{index:06d}.png"), truth)


def test_standard_error_is_that_of_blocks() -> None:
    assert block_error([1.0] * 5 + [3.0] * 5) == pytest.approx(1.0), "standard deviation sqrt(2) of two blocks"
    assert block_error([2.0] * 6 + [4.0] * 5) == pytest.approx(1.0), "blocks of six and five"
    assert block_error([0.0, 1.0] * 4 + [0.0]) is None


def test_streets_count_alike_and_have_standard_errors(tmp_path: Path) -> None:
    write_pairs(tmp_path / "pairs", "06", [True] * 5 + [False] * 5)
    write_pairs(tmp_path / "pairs", "08", [False] * 20)
    mean, first, second = depth_protocol(Flat(), [tmp_path / "pairs"], allow_leak=False)  # type: ignore[arg-type]
    assert [row["street"] for row in (first, second)] == ["folder/pairs/06", "folder/pairs/08"]
    assert [row["images"] for row in (mean, first, second)] == [30, 10, 20]
    assert first["abs_rel"] == first["abs_rel_se"] == pytest.approx(0.0625)
    assert second["abs_rel"] == second["abs_rel_se"] == 0
    assert mean["abs_rel"] == mean["abs_rel_se"] == pytest.approx(0.0625 / 2), "not by their images"
    assert mean["a1"] == pytest.approx((1 - 0.25 / 2 + 1) / 2)


def test_drives_with_lidar_and_worlds_are_streets(
    tmp_path: Path, write_drive: Callable[..., Path], write_root: Callable[..., Path]
) -> None:
    roots = [write_drive(tmp_path / "raw"), write_root(tmp_path / "world", frames=11, depth=True, seed=600)]
    rows = depth_protocol(Flat(), roots, allow_leak=False)  # type: ignore[arg-type]
    assert [row.get("street") for row in rows] == [None, "kitti_raw/2011_09_26_drive_0099", "simulated/600"]
    assert [row["images"] for row in rows] == [5, 2, 3], "every fifth frame"
    assert rows[0]["abs_rel"] == pytest.approx(0, abs=1e-3)
    assert rows[0]["abs_rel_se"] is None and "fewer than 10 images" in rows[0]["abs_rel_se_reason"]


def test_a_leak_of_one_street_is_refused(tmp_path: Path, write_root: Callable[..., Path]) -> None:
    write_pairs(tmp_path / "pairs", "06", [True])
    roots = [tmp_path / "pairs", write_root(tmp_path / "kitti", frames=2, depth=True)]
    with pytest.raises(DataError, match=r"leak: .* kitti_odometry/00\[0:2\]"):
        depth_protocol(Flat(), roots, allow_leak=False)  # type: ignore[arg-type]
    rows = depth_protocol(Flat(), roots, allow_leak=True)  # type: ignore[arg-type]
    assert [row["leak"] for row in rows] == [True, False, True]
