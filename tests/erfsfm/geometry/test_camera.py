"""The camera matrix under resize, crop and flip of the image."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from erfsfm.geometry.camera import Camera, backproject, pixel_grid, scale_intrinsics

CAMERA = Camera(width=400, height=120, fx=300.0, fy=280.0, cx=190.0, cy=61.5)
POINTS = np.random.default_rng(1).uniform([-2, -1, 2], [2, 1, 9], (50, 3))


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels ``(N, 2)`` of points in the camera frame."""
    homogeneous = points @ camera.K.astype(np.float64).T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def test_resize_keeps_half_pixels() -> None:
    half = Camera(8, 4, 10, 10, 3.5, 1.5).resized(4, 2)
    assert (half.cx, half.cy) == (1.5, 0.5), "the centre of the image stays the centre"
    assert (half.fx, half.fy) == (5, 5)


def test_the_paper_resizes_without_half_pixels() -> None:
    """Camera 2 of KITTI 00: the reference has cx 607.1928 * 416 / 1241."""
    kitti = Camera(1241, 376, 718.856, 718.856, 607.1928, 185.2157)
    paper = kitti.resized(416, 128, "paper")
    assert (paper.width, paper.height) == (416, 128)
    np.testing.assert_allclose([paper.fx, paper.fy, paper.cx, paper.cy], [240.97, 244.717, 203.54, 63.052], atol=5e-3)
    assert kitti.resized(416, 128).cx == pytest.approx(203.207, abs=1e-3)


@pytest.mark.parametrize("size", [(416, 128), (200, 240), (33, 7)])
def test_project_then_resize(size: tuple[int, int]) -> None:
    scale = np.array([size[0] / CAMERA.width, size[1] / CAMERA.height])
    expected = (project(CAMERA, POINTS) + 0.5) * scale - 0.5
    np.testing.assert_allclose(project(CAMERA.resized(*size), POINTS), expected, atol=1e-4)


def test_project_then_crop() -> None:
    cropped = CAMERA.cropped(17, 5, 100, 80)
    assert (cropped.width, cropped.height) == (100, 80)
    np.testing.assert_allclose(project(cropped, POINTS), project(CAMERA, POINTS) - [17, 5], atol=1e-4)


def test_project_then_flip() -> None:
    pixels = project(CAMERA, POINTS)
    mirrored = POINTS * [-1, 1, 1]
    np.testing.assert_allclose(
        project(CAMERA.flipped(), mirrored), np.column_stack([399 - pixels[:, 0], pixels[:, 1]]), atol=1e-4
    )


def test_scale_intrinsics_of_the_paper() -> None:
    """Both rows by the height ratio, no half pixel: 75 x 248 at the third level is 10 x 31."""
    K = torch.tensor([[[200.0, 0, 124], [0, 210, 37], [0, 0, 1]]])
    level = scale_intrinsics(K, (10, 31), (75, 248), "paper")[0]
    ratio = 10 / 75
    expected = torch.tensor([[200 * ratio, 0, 124 * ratio], [0, 210 * ratio, 37 * ratio], [0, 0, 1]])
    torch.testing.assert_close(level, expected)
    exact = scale_intrinsics(K, (10, 31), (75, 248), "default")[0]
    assert float(level[0, 0] / exact[0, 0]) == pytest.approx(1.067, abs=1e-3), "the reference's 6.7 % error"


def test_backproject_hand_value() -> None:
    K = torch.tensor([[[2.0, 0, 1], [0, 4, 0], [0, 0, 1]]])
    points = backproject(torch.full((1, 1, 2, 3), 8.0), K)
    assert points.shape == (1, 3, 6)
    assert points[0, :, 0].tolist() == [-4, 0, 8]  # pixel (0, 0)
    assert points[0, :, 5].tolist() == [4, 2, 8]  # pixel (2, 1)


def test_backproject_undoes_project() -> None:
    depth = torch.rand(2, 1, 5, 7).double() + 1
    K = torch.from_numpy(CAMERA.resized(7, 5).K).double().expand(2, 3, 3)
    homogeneous = K @ backproject(depth, K)
    torch.testing.assert_close(homogeneous / homogeneous[:, 2:], pixel_grid(5, 7, depth).expand(2, 3, 35))


def test_backproject_gradient() -> None:
    depth = (torch.rand(1, 1, 2, 3).double() + 1).requires_grad_()
    K = torch.tensor([[[3.0, 0, 1], [0, 3, 1], [0, 0, 1]]]).double().requires_grad_()
    assert torch.autograd.gradcheck(backproject, (depth, K))
