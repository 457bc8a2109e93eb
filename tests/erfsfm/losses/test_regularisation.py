"""Smoothness and the prior on masks, by hand."""

from __future__ import annotations

import math

import pytest
import torch

from erfsfm.losses.photometric import edge_aware_smoothness, second_order_smoothness


def ramp(height: int, width: int) -> torch.Tensor:
    """``1 + 2 u + 3 v`` as ``(1, 1, H, W)``."""
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return (1.0 + 2 * u + 3 * v)[None, None]


def test_a_parabola_by_hand() -> None:
    """u^2 has a second difference of 2 along u, nothing else."""
    u = torch.arange(9.0)
    assert float(second_order_smoothness((u**2).expand(1, 1, 5, 9))) == pytest.approx(2)


def test_one_spike_by_hand() -> None:
    values = torch.zeros(1, 1, 5, 5)
    values[0, 0, 2, 2] = 1
    # along each axis -1 2 -1 over 5 x 3 places; mixed four ones over 4 x 4, twice
    assert float(second_order_smoothness(values)) == pytest.approx(2 * 4 / 15 + 2 * 4 / 16)


def test_edge_aware_by_hand() -> None:
    """A ramp 1, 2, 3 of mean 2 has normalised steps of 1/2; an edge of 1 in all colours damps by e^-1."""
    values = torch.tensor([[1.0, 2.0, 3.0]] * 2)[None, None]
    flat = torch.zeros(1, 3, 2, 3)
    assert float(edge_aware_smoothness(values, flat)) == pytest.approx(0.5, abs=1e-6)
    edge = flat.clone()
    edge[..., 1:] = 1
    assert float(edge_aware_smoothness(values, edge)) == pytest.approx((0.5 + 0.5 * math.exp(-1)) / 2, abs=1e-6)
