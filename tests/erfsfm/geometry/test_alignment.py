"""Motion by least squares from correspondences that are known exactly."""

import pytest
import torch

from erfsfm.geometry.alignment import align, cell_rays, project, rotation_to_euler, solve
from erfsfm.geometry.transforms import euler_to_rotation

ROWS, COLUMNS = 16, 52
STEPS = (100.0, 6.0, 3.0, 3.0, 2.0, 2.0)


@pytest.fixture
def rays() -> torch.Tensor:
    return cell_rays(ROWS, COLUMNS, torch.device("cpu"))


@pytest.fixture
def inverse_depth() -> torch.Tensor:
    return torch.rand(2, ROWS * COLUMNS, generator=torch.Generator().manual_seed(0)) + 0.05


def truth() -> tuple[torch.Tensor, torch.Tensor]:
    euler = torch.tensor([[0.01, 0.12, -0.01], [0.0, -0.03, 0.0]])
    return euler_to_rotation(euler), torch.tensor([[0.01, 0.0, -0.1], [0.0, 0.0, 0.06]])


def found(seen, rays, value, sigma=0.1):
    start = torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3)
    return align(seen, torch.full_like(seen, 0.5), rays, (value, sigma * value), start, STEPS)


def test_exact_matches_give_the_motion(rays, inverse_depth):
    R, t = truth()
    seen = project(rays, inverse_depth, R, t)[1]
    R_found, t_found = found(seen, rays, inverse_depth)
    torch.testing.assert_close(R_found, R, atol=2e-4, rtol=0)
    torch.testing.assert_close(t_found, t, atol=2e-3, rtol=0)


def test_matches_that_move_along_do_not_count(rays, inverse_depth):
    R, t = truth()
    seen = project(rays, inverse_depth, R, t)[1]
    cars = torch.rand(ROWS * COLUMNS, generator=torch.Generator().manual_seed(1)) < 0.2
    seen[:, cars, 0] += 0.1
    R_found, _ = found(seen, rays, inverse_depth)
    angle = (R_found.transpose(1, 2) @ R - torch.eye(3)).norm(dim=(1, 2)) / 2**0.5
    assert (angle < 2e-3).all()


def test_an_uncertain_depth_turns_the_camera_less(rays, inverse_depth):
    R, t = truth()
    seen = project(rays, inverse_depth, R, t)[1]
    wrong = torch.where(rays[:, 0] > 0.3, 0.5 * inverse_depth, inverse_depth)  # one side seems twice as far

    def angle(sigma: float) -> float:
        R_found, _ = found(seen, rays, wrong, sigma)
        return float((R_found.transpose(1, 2) @ R - torch.eye(3)).norm())

    assert angle(0.5) < 0.7 * angle(0.02)


def test_linear_systems_and_angles():
    generator = torch.Generator().manual_seed(2)
    roots = torch.randn(3, 6, 6, generator=generator)
    A, b = roots @ roots.transpose(1, 2) + torch.eye(6), torch.randn(3, 6, generator=generator)
    torch.testing.assert_close(solve(A, b), torch.linalg.solve(A, b), atol=1e-4, rtol=1e-3)
    euler = 0.3 * torch.randn(5, 3, generator=generator)
    torch.testing.assert_close(rotation_to_euler(euler_to_rotation(euler)), euler)
