"""The photometric error and its fast 3 x 3 mean."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from erfsfm.losses import (
    Bounds,
    disagreement,
    dissimilarity,
    edge_aware_smoothness,
    enlarged,
    photometric_error,
    rotation_disagreement,
    second_order_smoothness,
    step_disagreement,
    translation_disagreement,
)


def naive_dissimilarity(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(1 - SSIM) / 2 of two ``(H, W)`` images, pixel by pixel, float64."""
    a, b = np.pad(first, 1, mode="reflect"), np.pad(second, 1, mode="reflect")
    out = np.empty(first.shape)
    for row in range(first.shape[0]):
        for column in range(first.shape[1]):
            x = a[row : row + 3, column : column + 3].ravel()
            y = b[row : row + 3, column : column + 3].ravel()
            covariance = ((x - x.mean()) * (y - y.mean())).mean()
            ssim = (2 * x.mean() * y.mean() + 0.01**2) * (2 * covariance + 0.03**2)
            ssim /= (x.mean() ** 2 + y.mean() ** 2 + 0.01**2) * (x.var() + y.var() + 0.03**2)
            out[row, column] = np.clip((1 - ssim) / 2, 0, 1)
    return out


def test_dissimilarity_matches_a_naive_reference():
    first, second = torch.rand(2, 2, 3, 6, 7, dtype=torch.float64)
    result = dissimilarity(first, second)
    for batch in range(2):
        for channel in range(3):
            expected = naive_dissimilarity(
                first[batch, channel].numpy(), second[batch, channel].numpy()
            )
            np.testing.assert_allclose(result[batch, channel].numpy(), expected, atol=1e-12)


def test_ssim_of_flat_images_by_hand():
    """Without structure the luminance alone counts: (2ab + C1) / (a^2 + b^2 + C1)."""
    a, b = 0.2, 0.8
    target, warped = torch.full((1, 3, 4, 5), a).double(), torch.full((1, 3, 4, 5), b).double()
    structural = (1 - (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)) / 2
    expected = torch.full((1, 1, 4, 5), 0.85 * structural + 0.15 * 0.6).double()
    torch.testing.assert_close(photometric_error(target, warped, 0.85), expected)


def test_gradient():
    target = torch.rand(1, 3, 4, 5, dtype=torch.float64)
    warped = torch.rand(1, 3, 4, 5, dtype=torch.float64, requires_grad=True)

    def error(warped: Tensor) -> Tensor:
        return photometric_error(target, warped, 0.85)

    assert torch.autograd.gradcheck(error, (warped,))


def test_gradient_at_equal_images_is_finite():
    image = torch.rand(1, 3, 5, 5)
    warped = image.clone().requires_grad_()
    photometric_error(image, warped, 0.85).sum().backward()
    assert warped.grad is not None
    assert torch.isfinite(warped.grad).all()


def ramp(height: int, width: int) -> torch.Tensor:
    """``1 + 2 u + 3 v`` as ``(1, 1, H, W)``."""
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return (1.0 + 2 * u + 3 * v)[None, None]


def test_a_parabola_by_hand():
    """u^2 has a second difference of 2 along u, nothing else."""
    u = torch.arange(9.0)
    assert float(second_order_smoothness((u**2).expand(1, 1, 5, 9))) == pytest.approx(2)


def test_one_spike_by_hand():
    values = torch.zeros(1, 1, 5, 5)
    values[0, 0, 2, 2] = 1
    # along each axis -1 2 -1 over 5 x 3 places; mixed four ones over 4 x 4, twice
    assert float(second_order_smoothness(values)) == pytest.approx(2 * 4 / 15 + 2 * 4 / 16)


def test_edge_aware_by_hand():
    """A ramp 1, 2, 3 of mean 2 has normalised steps of 1/2; an edge of 1 in all colours damps by e^-1."""
    values = torch.tensor([[1.0, 2.0, 3.0]] * 2)[None, None]
    flat = torch.zeros(1, 3, 2, 3)
    assert float(edge_aware_smoothness(values, flat)) == pytest.approx(0.5, abs=1e-6)
    edge = flat.clone()
    edge[..., 1:] = 1
    assert float(edge_aware_smoothness(values, edge)) == pytest.approx(
        (0.5 + 0.5 * math.exp(-1)) / 2, abs=1e-6
    )


def bounds(least: float, most: float) -> Bounds:
    return (torch.full((1, 1, 4, 4), least), torch.full((1, 1, 4, 4), most))


ZERO = torch.zeros(1, 1, 1, 1)


HALF = math.log(1.5) / 2  # width of the bounds below


@pytest.mark.parametrize(
    ("ratio", "expected"),
    [
        (0, 0.0),
        (HALF / 2, HALF / 8),
        (-HALF, HALF / 2),
        (HALF + 1, 1 + HALF / 2),
        (-HALF - 1, 1 + HALF / 2),
    ],
    ids=["middle", "in", "least", "near", "far"],
)
def test_between_bounds_the_middle_draws_and_beyond_them_the_loss_is_linear(ratio, expected):
    disparity = torch.full((1, 1, 4, 4), math.sqrt(0.2 * 0.3) * math.exp(ratio), requires_grad=True)
    distance = disagreement(disparity, bounds(0.2, 0.3), ZERO)
    assert distance.item() == pytest.approx(expected, abs=1e-5)
    distance.backward()
    assert disparity.grad is not None
    slope = (disparity.grad * disparity).sum().item()  # of the loss by log disparity
    assert slope == pytest.approx(max(-1, min(1, ratio / HALF)), abs=1e-4)


@pytest.mark.parametrize("size", [(128, 416), (94, 310), (75, 248)])
def test_on_a_level_road_every_level_of_the_networks_agrees_with_the_labels(size):
    def road(rows):  # inverse depth, linear in the image row, of a horizon above the image
        return 0.01 * (rows + 3.0)

    full = road(torch.arange(size[0], dtype=torch.float32))[:, None].expand(1, 1, *size)
    for level in range(4):
        step = 2**level
        height, width = (math.ceil(length / step) for length in size)
        middles = step * torch.arange(height, dtype=torch.float32) + (step - 1) / 2
        shown = enlarged(road(middles)[:, None].expand(1, 1, height, width), level, size)
        assert shown.shape == full.shape
        inside = slice(
            step, size[0] - size[0] % step - step
        )  # at the border there is no row to interpolate to
        assert torch.allclose(shown[..., inside, :], full[..., inside, :], rtol=1e-5), (
            f"level {level}"
        )


def test_unbounded_pixels_affect_neither_loss_nor_gradients():
    disparity = torch.full((1, 1, 4, 4), 0.5, requires_grad=True)
    least, most = torch.zeros(1, 1, 4, 4), torch.full((1, 1, 4, 4), torch.inf)
    most[..., 0, 0] = 0.25  # something far: only bounded from above
    interval = (least, most)
    distance = disagreement(disparity, interval, ZERO)
    assert distance.item() == pytest.approx(0.6931, abs=1e-4)
    distance.backward()
    assert disparity.grad is not None and torch.isfinite(disparity.grad).all()
    assert disparity.grad.count_nonzero() == 1


def test_a_lower_bound_alone_penalises_farther_depth():
    disparity = torch.tensor([[[[0.05, 0.2]]]], requires_grad=True)
    interval = (torch.full((1, 1, 1, 2), 0.1), torch.full((1, 1, 1, 2), torch.inf))
    distance = disagreement(disparity, interval, ZERO)
    assert distance.item() == pytest.approx(0.6931, abs=1e-4), "the satisfied pixel does not count"
    distance.backward()
    assert (
        disparity.grad is not None
        and disparity.grad[0, 0, 0, 0] < 0
        and disparity.grad[0, 0, 0, 1] == 0
    )


def test_translation_by_hand_with_one_unmeasured():
    predicted = torch.tensor([[0.0, 0.0, 1.0], [5.0, 5.0, 5.0]])
    measured = torch.tensor([[0.0, 0.0, 2.0], [torch.nan] * 3])
    assert translation_disagreement(predicted, measured).item() == pytest.approx(1 / 2.01, rel=1e-5)


def test_steps_between_pixels_by_hand():
    least = torch.full((1, 1, 1, 16), 0.099)
    least[..., 8:] = 0.198
    labels = (least, least * 0.101 / 0.099)
    edge = (least * labels[1]).sqrt()
    assert step_disagreement(edge, labels).item() == pytest.approx(0, abs=1e-6)
    assert step_disagreement(5 * edge, labels).item() == pytest.approx(0, abs=1e-6)  # at any scale
    flat = step_disagreement(torch.full_like(edge, 0.14), labels).item()
    pairs = [
        (15, 1),
        (14, 2),
        (12, 4),
        (8, 8),
    ]  # columns apart 1, 2, 4 and 8, and those across the edge
    expected = sum(crossing / count for count, crossing in pairs) * 0.6931 / 8  # rows have no pairs
    assert flat == pytest.approx(expected, rel=1e-3)


def test_rotation_disagreement_is_the_chordal_distance_to_measured_rotations():
    angle = 0.3
    turned = torch.eye(3).repeat(1, 2, 1, 1)
    turned[0, 0, :2, :2] = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    measured = torch.eye(3).repeat(1, 2, 1, 1)
    measured[0, 1] = torch.nan
    predicted = turned.clone().requires_grad_()
    distance = rotation_disagreement(predicted, measured)
    assert distance.item() == pytest.approx(2 * math.sqrt(2) * math.sin(angle / 2), abs=1e-5)
    distance.backward()
    assert torch.isfinite(predicted.grad).all() and (predicted.grad[0, 1] == 0).all()


def test_sky_that_is_far_enough_does_not_dilute_what_is_measured():
    disparity = torch.full((1, 1, 4, 4), 0.1)
    least, most = torch.full((1, 1, 4, 4), 0.2), torch.full((1, 1, 4, 4), 0.2)
    all_measured = disagreement(disparity, (least, most), ZERO)
    least[..., :2, :], most[..., :2, :] = 0, 0.5
    torch.testing.assert_close(disagreement(disparity, (least, most), ZERO), all_measured)
