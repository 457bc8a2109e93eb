import math

import pytest
import torch

from erfsfm.losses.structure import (
    Bounds,
    disagreement,
    enlarged,
    rotation_disagreement,
    step_disagreement,
    translation_disagreement,
)


def bounds(least: float, most: float) -> Bounds:
    return Bounds(torch.full((1, 1, 4, 4), least), torch.full((1, 1, 4, 4), most))


ZERO = torch.zeros(1, 1, 1, 1)


HALF = math.log(1.5) / 2  # width of the bounds below


@pytest.mark.parametrize(
    ("ratio", "expected"),
    [(0, 0.0), (HALF / 2, HALF / 8), (-HALF, HALF / 2), (HALF + 1, 1 + HALF / 2), (-HALF - 1, 1 + HALF / 2)],
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
        inside = slice(step, size[0] - size[0] % step - step)  # at the border there is no row to interpolate to
        assert torch.allclose(shown[..., inside, :], full[..., inside, :], rtol=1e-5), f"level {level}"


def test_unbounded_pixels_affect_neither_loss_nor_gradients():
    disparity = torch.full((1, 1, 4, 4), 0.5, requires_grad=True)
    least, most = torch.zeros(1, 1, 4, 4), torch.full((1, 1, 4, 4), torch.inf)
    most[..., 0, 0] = 0.25  # something far: only bounded from above
    interval = Bounds(least, most)
    distance = disagreement(disparity, interval, ZERO)
    assert distance.item() == pytest.approx(0.6931, abs=1e-4)
    distance.backward()
    assert disparity.grad is not None and torch.isfinite(disparity.grad).all()
    assert disparity.grad.count_nonzero() == 1


def test_a_lower_bound_alone_penalises_farther_depth():
    disparity = torch.tensor([[[[0.05, 0.2]]]], requires_grad=True)
    interval = Bounds(torch.full((1, 1, 1, 2), 0.1), torch.full((1, 1, 1, 2), torch.inf))
    distance = disagreement(disparity, interval, ZERO)
    assert distance.item() == pytest.approx(0.6931, abs=1e-4), "the satisfied pixel does not count"
    distance.backward()
    assert disparity.grad is not None and disparity.grad[0, 0, 0, 0] < 0 and disparity.grad[0, 0, 0, 1] == 0


def test_translation_by_hand_with_one_unmeasured():
    predicted = torch.tensor([[0.0, 0.0, 1.0], [5.0, 5.0, 5.0]])
    measured = torch.tensor([[0.0, 0.0, 2.0], [torch.nan] * 3])
    assert translation_disagreement(predicted, measured).item() == pytest.approx(1 / 2.01, rel=1e-5)


def test_steps_between_pixels_by_hand():
    least = torch.full((1, 1, 1, 16), 0.099)
    least[..., 8:] = 0.198
    labels = Bounds(least, least * 0.101 / 0.099)
    edge = (least * labels.most).sqrt()
    assert step_disagreement(edge, labels).item() == pytest.approx(0, abs=1e-6)
    assert step_disagreement(5 * edge, labels).item() == pytest.approx(0, abs=1e-6)  # at any scale
    flat = step_disagreement(torch.full_like(edge, 0.14), labels).item()
    pairs = [(15, 1), (14, 2), (12, 4), (8, 8)]  # columns apart 1, 2, 4 and 8, and those across the edge
    expected = sum(crossing / count for count, crossing in pairs) * 0.6931 / 8  # rows have no pairs
    assert flat == pytest.approx(expected, rel=1e-3)


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


def test_sky_that_is_far_enough_does_not_dilute_what_is_measured():
    disparity = torch.full((1, 1, 4, 4), 0.1)
    least, most = torch.full((1, 1, 4, 4), 0.2), torch.full((1, 1, 4, 4), 0.2)
    all_measured = disagreement(disparity, Bounds(least, most), ZERO)
    least[..., :2, :], most[..., :2, :] = 0, 0.5
    torch.testing.assert_close(disagreement(disparity, Bounds(least, most), ZERO), all_measured)
