"""Six-vectors, rotations and the transform of points."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from erfsfm.geometry.transforms import euler_to_rotation, pose_vector_to_matrix, transform_points

ANGLES = [0.0, 1e-8, 1e-3, 1.0, math.pi / 2, math.pi - 1e-6, math.pi, 2 * math.pi, -2.5]


@pytest.mark.parametrize("angle", ANGLES)
def test_euler_is_scipys_intrinsic_xyz(angle: float) -> None:
    euler = torch.tensor([angle, 0.3 - angle, 0.7 * angle], dtype=torch.float64)
    expected = torch.from_numpy(Rotation.from_euler("XYZ", euler.numpy()).as_matrix())
    torch.testing.assert_close(euler_to_rotation(euler), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rotations_are_rotations(angle: float, axis: int) -> None:
    euler = torch.zeros(3, dtype=torch.float64)
    euler[axis] = angle
    R = euler_to_rotation(euler)
    torch.testing.assert_close(R @ R.T, torch.eye(3).double())
    assert float(torch.linalg.det(R)) == pytest.approx(1)


def test_quarter_turns_by_hand() -> None:
    quarter = math.pi / 2
    x, y, z = torch.eye(3).double()
    about_x, about_y, about_z = euler_to_rotation(quarter * torch.eye(3).double())
    torch.testing.assert_close(about_x @ y, z)
    torch.testing.assert_close(about_y @ z, x)
    torch.testing.assert_close(about_z @ x, y)


def test_translation_comes_first() -> None:
    T = pose_vector_to_matrix(torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, math.pi]))
    assert T[:3, 3].tolist() == [1, 2, 3]
    torch.testing.assert_close(T[:3, :3], torch.diag(torch.tensor([-1.0, -1.0, 1.0])), rtol=0, atol=1e-6)
    assert T[3].tolist() == [0, 0, 0, 1]


def test_transform_points_rotates_then_translates() -> None:
    T_a_b = pose_vector_to_matrix(torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.0, math.pi / 2]]).double())
    points_b = torch.tensor([[[1.0], [0.0], [5.0]]]).double()
    torch.testing.assert_close(transform_points(T_a_b, points_b), torch.tensor([[[1.0], [1.0], [5.0]]]).double())


def test_neighbours_cancel() -> None:
    T_a_b, T_b_c = pose_vector_to_matrix(torch.randn(2, 1, 6).double())
    points_c = torch.randn(1, 3, 7).double()
    torch.testing.assert_close(
        transform_points(T_a_b @ T_b_c, points_c), transform_points(T_a_b, transform_points(T_b_c, points_c))
    )


@pytest.mark.parametrize("angle", [0.0, 1.0, math.pi])
def test_gradients(angle: float) -> None:
    vector = torch.tensor([[0.1, 0.2, 0.3, angle, -angle, 0.5 * angle]], dtype=torch.float64, requires_grad=True)
    points = torch.randn(1, 3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v, p: transform_points(pose_vector_to_matrix(v), p), (vector, points))
