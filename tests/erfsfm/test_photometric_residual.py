"""The photometric residual of a pose: near 0 where depth and motion are true, large where they are not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from erfsfm.photometric_residual import PhotometricResidual, Thumbnail, thumbnail

WIDTH, HEIGHT = 416, 128
K = np.array([[240.0, 0.0, 207.5], [0.0, 240.0, 63.5], [0.0, 0.0, 1.0]])
DEPTH = 10.0


def wall(T_wall_camera: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A wall at z = 10 with soft stripes, as seen by a camera that does not rotate."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    depth = DEPTH - T_wall_camera[2, 3]
    x = (u - K[0, 2]) / K[0, 0] * depth + T_wall_camera[0, 3]
    y = (v - K[1, 2]) / K[1, 1] * depth + T_wall_camera[1, 3]
    grey = 128 + 60 * np.sin(2.0 * x) + 50 * np.sin(1.7 * y + 0.6 * x)
    return np.repeat(np.rint(grey).astype(np.uint8)[:, :, None], 3, axis=2)


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def view(T_world_camera: NDArray[np.float64]) -> Thumbnail:
    return thumbnail(cv2.cvtColor(wall(T_world_camera), cv2.COLOR_RGB2GRAY))


def ratio(moved: NDArray[np.float64], assumed: NDArray[np.float64], depth: float = DEPTH) -> float:
    """Residual of an assumed ``T_source_target`` for a source camera at ``moved``; the target is at the origin."""
    residual = PhotometricResidual(K, WIDTH, HEIGHT)
    disparity = np.full((HEIGHT, WIDTH), 1 / depth, np.float32)
    found = residual.ratios([view(moved), view(at()), view(at())], disparity, np.stack([assumed, np.eye(4)]))
    return float(found[0])


@pytest.mark.parametrize("moved", [at(x=0.4), at(z=1.0), at(0.2, -0.1, 0.6)])
def test_true_motion_and_depth_have_a_small_ratio(moved: NDArray[np.float64]) -> None:
    assert ratio(moved, np.linalg.inv(moved)) < 0.08


def test_no_motion_has_ratio_one() -> None:
    assert ratio(at(x=0.4), np.eye(4)) == pytest.approx(1.0)


@pytest.mark.parametrize("wrong", [at(x=0.2), at(x=-0.3), at(x=0.8)])
def test_a_wrong_motion_has_a_larger_ratio(wrong: NDArray[np.float64]) -> None:
    moved = at(x=0.4)
    assert ratio(moved, np.linalg.inv(wrong)) > 5 * ratio(moved, np.linalg.inv(moved))


def test_depth_and_translation_share_their_unit() -> None:
    """Both in another unit are the same motion; one of them alone is not."""
    moved = at(x=0.4)
    assumed = np.linalg.inv(moved)
    assumed[:3, 3] *= 0.25
    assert ratio(moved, assumed, depth=0.25 * DEPTH) == pytest.approx(ratio(moved, np.linalg.inv(moved)), abs=1e-6)
    assert ratio(moved, assumed) > 0.5


def test_views_without_overlap_have_ratio_one() -> None:
    assert ratio(at(x=0.4), at(x=50.0)) == 1.0
    assert ratio(at(z=1.0), at(z=-20.0)) == 1.0


def test_rows_follow_the_sources_in_time_order() -> None:
    residual = PhotometricResidual(K, WIDTH, HEIGHT)
    disparity = np.full((32, 104), 1 / DEPTH, np.float32)
    true = [np.linalg.inv(at(x=x)) for x in (-0.4, -0.2, 0.2, 0.4)]
    images = [view(at(x=x)) for x in (-0.4, -0.2, 0.0, 0.2, 0.4)]
    swapped = np.stack([true[0], true[1], true[3], true[2]])
    found = residual.ratios(images, disparity, swapped)
    assert (found[:2] < 0.1).all() and (found[2:] > 0.3).all()
