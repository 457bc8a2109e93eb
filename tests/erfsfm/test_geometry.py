"""The camera matrix under resize, crop and flip of the image."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from erfsfm.geometry import (
    Camera,
    backproject,
    euler_to_rotation,
    pixel_grid,
    pose_vector_to_matrix,
    project_into_source,
    sample,
    scale_intrinsics,
)

CAMERA = Camera(width=400, height=120, fx=300.0, fy=280.0, cx=190.0, cy=61.5)
POINTS = np.random.default_rng(1).uniform([-2, -1, 2], [2, 1, 9], (50, 3))


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels ``(N, 2)`` of points in the camera frame."""
    homogeneous = points @ camera.K.astype(np.float64).T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def test_the_paper_resizes_without_half_pixels():
    """Camera 2 of KITTI 00: the reference has cx 607.1928 * 416 / 1241."""
    kitti = Camera(1241, 376, 718.856, 718.856, 607.1928, 185.2157)
    paper = kitti.resized(416, 128, "paper")
    assert (paper.width, paper.height) == (416, 128)
    np.testing.assert_allclose(
        [paper.fx, paper.fy, paper.cx, paper.cy], [240.97, 244.717, 203.54, 63.052], atol=5e-3
    )
    assert kitti.resized(416, 128).cx == pytest.approx(203.207, abs=1e-3)


@pytest.mark.parametrize("size", [(416, 128), (200, 240), (33, 7)])
def test_project_then_resize(size: tuple[int, int]):
    scale = np.array([size[0] / CAMERA.width, size[1] / CAMERA.height])
    expected = (project(CAMERA, POINTS) + 0.5) * scale - 0.5
    np.testing.assert_allclose(project(CAMERA.resized(*size), POINTS), expected, atol=1e-4)


def test_project_then_crop():
    cropped = CAMERA.cropped(17, 5, 100, 80)
    assert (cropped.width, cropped.height) == (100, 80)
    np.testing.assert_allclose(
        project(cropped, POINTS), project(CAMERA, POINTS) - [17, 5], atol=1e-4
    )


def test_project_then_flip():
    pixels = project(CAMERA, POINTS)
    mirrored = POINTS * [-1, 1, 1]
    np.testing.assert_allclose(
        project(CAMERA.flipped(), mirrored),
        np.column_stack([399 - pixels[:, 0], pixels[:, 1]]),
        atol=1e-4,
    )


def test_scale_intrinsics_of_the_paper():
    """Both rows by the height ratio, no half pixel: 75 x 248 at the third level is 10 x 31."""
    K = torch.tensor([[[200.0, 0, 124], [0, 210, 37], [0, 0, 1]]])
    level = scale_intrinsics(K, (10, 31), (75, 248), "paper")[0]
    ratio = 10 / 75
    expected = torch.tensor(
        [[200 * ratio, 0, 124 * ratio], [0, 210 * ratio, 37 * ratio], [0, 0, 1]]
    )
    torch.testing.assert_close(level, expected)
    exact = scale_intrinsics(K, (10, 31), (75, 248), "default")[0]
    assert float(level[0, 0] / exact[0, 0]) == pytest.approx(1.067, abs=1e-3), (
        "the reference's 6.7 % error"
    )


def test_backproject_undoes_project():
    depth = torch.rand(2, 1, 5, 7).double() + 1
    K = torch.from_numpy(CAMERA.resized(7, 5).K).double().expand(2, 3, 3)
    homogeneous = K @ backproject(depth, K)
    torch.testing.assert_close(
        homogeneous / homogeneous[:, 2:], pixel_grid(5, 7, depth).expand(2, 3, 35)
    )


ANGLES = [0.0, 1e-8, 1e-3, 1.0, math.pi / 2, math.pi - 1e-6, math.pi, 2 * math.pi, -2.5]


@pytest.mark.parametrize("angle", ANGLES)
def test_euler_is_scipys_intrinsic_xyz(angle: float):
    euler = torch.tensor([angle, 0.3 - angle, 0.7 * angle], dtype=torch.float64)
    expected = torch.from_numpy(Rotation.from_euler("XYZ", euler.numpy()).as_matrix())
    torch.testing.assert_close(euler_to_rotation(euler), expected, rtol=0, atol=1e-14)


def test_a_pose_rotates_then_translates():
    T_a_b = pose_vector_to_matrix(torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.0, math.pi / 2]]).double())
    point_b = torch.tensor([1.0, 0.0, 5.0, 1.0]).double()
    torch.testing.assert_close(T_a_b[0] @ point_b, torch.tensor([1.0, 1.0, 5.0, 1.0]).double())


def camera(width: int, height: int, focal: float = 50.0) -> Tensor:
    return torch.tensor([[[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]])


def moved(*translation: float) -> Tensor:
    return pose_vector_to_matrix(torch.tensor([[*translation, 0.0, 0.0, 0.0]]))


@pytest.mark.parametrize("size", [(128, 416), (75, 248), (94, 310), (33, 47)])
def test_identity_returns_the_image_with_its_border(size: tuple[int, int]):
    image = torch.rand(1, 3, *size)
    depth = torch.rand(1, 1, *size) * 90 + 0.1
    K = torch.tensor(
        [[[0.58 * size[1], 0, 0.49 * size[1]], [0, 1.92 * size[0], 0.51 * size[0]], [0, 0, 1]]]
    )
    grid, valid = project_into_source(depth, torch.eye(4)[None], K)
    assert valid.all(), "round-off must not cut the border off"
    torch.testing.assert_close(sample(image, grid), image, rtol=0, atol=2e-4)


@pytest.mark.parametrize("shift", [1, 3, -2])
def test_sideways_motion_shifts_a_plane_by_whole_pixels(shift: int):
    """A plane at 5 m, focal length 50: the source sees its points ``50 t / 5`` pixels further right."""
    width, height = 40, 20
    image = torch.rand(1, 3, height, width)
    grid, valid = project_into_source(
        torch.full((1, 1, height, width), 5.0), moved(shift * 0.1, 0, 0), camera(40, 20)
    )
    warped = sample(image, grid)
    expected = torch.roll(image, -shift, dims=3)
    inside = torch.zeros(width, dtype=torch.bool)
    inside[max(-shift, 0) : width - max(shift, 0)] = True
    assert torch.equal(valid[0, 0], inside.expand(height, width))
    torch.testing.assert_close(warped[..., inside], expected[..., inside], rtol=0, atol=1e-4)


def test_forward_motion_by_hand():
    """A point 10 m ahead is 8 m ahead of a source camera 2 m further on: T_source_target has t_z = -2."""
    grid, _ = project_into_source(torch.full((1, 1, 21, 41), 10.0), moved(0, 0, -2), camera(41, 21))
    # a pixel 8 right of the centre moves to 8 * 10 / 8 = 10 right of it
    assert float(grid[0, 10, 28, 0]) == pytest.approx(2 * (20 + 10) / 40 - 1, abs=1e-6)
    assert float(grid[0, 10, 28, 1]) == pytest.approx(0, abs=1e-6)


def test_points_behind_the_camera_are_invalid():
    depth = torch.full((1, 1, 11, 11), 3.0)
    assert not project_into_source(depth, moved(0, 0, -5), camera(11, 11))[1].any()
    assert not project_into_source(depth, moved(0, 0, -3), camera(11, 11))[1].any(), (
        "nor those in its plane"
    )


@pytest.mark.parametrize("bad", [float("inf"), float("nan"), 1e30])
def test_extreme_depth_gives_finite_values(bad: float):
    image = torch.rand(1, 3, 8, 8)
    depth = torch.full((1, 1, 8, 8), bad)
    grid, _ = project_into_source(depth, moved(1e5, 0, 0), camera(8, 8))
    assert torch.isfinite(sample(image, grid)).all()
