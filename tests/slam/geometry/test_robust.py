"""Robust scale and weighted medians against values known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from slam.geometry.robust import mad_sigma, median, weighted_median


def test_the_sigma_of_normal_errors_survives_a_third_of_outliers():
    errors = np.random.default_rng(0).normal(scale=2.0, size=(20_000, 2))
    spoilt = np.concatenate([errors[:, 0], np.full(2_000, 1e6)])
    assert mad_sigma(spoilt) == pytest.approx(2.0, rel=0.2)


@pytest.mark.parametrize("shape", [(1,), (2,), (7, 3), (8, 5)])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_the_median_is_that_of_numpy(shape: tuple[int, ...], kind: type):
    values = np.random.default_rng(0).normal(size=shape).astype(kind)
    assert median(values) == np.median(values)


def test_a_weighted_median_is_where_half_of_the_weight_lies():
    values = np.array([3.0, 1.0, 2.0])
    assert weighted_median(values, np.array([1.0, 1.0, 1.0])) == 2.0
    assert weighted_median(values, np.array([10.0, 1.0, 1.0])) == 3.0
