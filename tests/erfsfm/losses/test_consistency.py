"""Agreement of depth maps."""

from __future__ import annotations

import math

import pytest
import torch

from erfsfm.losses.consistency import depth_inconsistency, rotation_disagreement


def test_by_hand() -> None:
    assert float(depth_inconsistency(torch.tensor(3.0), torch.tensor(1.0))) == 0.5
    assert float(depth_inconsistency(torch.tensor(7.0), torch.tensor(7.0))) == 0


def test_bounds_symmetry_and_scale() -> None:
    first, second = torch.rand(2, 4, 1, 5, 6) * 99 + 0.01
    disagreement = depth_inconsistency(first, second)
    assert float(disagreement.min()) >= 0
    assert float(disagreement.max()) < 1
    torch.testing.assert_close(disagreement, depth_inconsistency(second, first))
    torch.testing.assert_close(disagreement, depth_inconsistency(first * 7, second * 7))


@pytest.mark.parametrize("ratio", [1.01, 2.0, 100.0])
def test_worse_agreement_is_a_larger_value(ratio: float) -> None:
    depth = torch.rand(1, 1, 4, 4) + 1
    assert (depth_inconsistency(depth, depth * ratio * 1.1) > depth_inconsistency(depth, depth * ratio)).all()


def test_rotation_disagreement_is_the_chordal_distance_to_measured_rotations():
    angle = 0.3
    turned = torch.eye(3).repeat(1, 2, 1, 1)
    turned[0, 0, :2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    measured = torch.eye(3).repeat(1, 2, 1, 1)
    measured[0, 1] = torch.nan
    predicted = turned.clone().requires_grad_()
    distance = rotation_disagreement(predicted, measured)
    assert distance.item() == pytest.approx(2 * math.sqrt(2) * math.sin(angle / 2), abs=1e-5)
    distance.backward()
    assert torch.isfinite(predicted.grad).all() and (predicted.grad[0, 1] == 0).all()
