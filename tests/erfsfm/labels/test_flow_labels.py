"""Labels by flow alone against simulated worlds, whose truth is exact."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from labelled_street import FRAME, errors, seen, truth

from erfsfm.labels.flow_labels import (
    NEIGHBOURS,
    combine,
    label,
    measure,
    rays,
    sky_mask,
    triangulate,
)
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet


def test_bounds_are_narrow_in_camera_heights_and_hold_the_truth():
    (least, most), true = label(*seen(FRAME, NEIGHBOURS)), truth(FRAME)
    error, known = errors((least, most), true)
    assert known > 0.35 and np.median(error) < 0.03
    narrow = (least > 0) & (most < 1.5 * least) & (true > 0)
    widened = (0.9 * least[narrow] < true[narrow]) & (true[narrow] < 1.1 * most[narrow])
    assert widened.mean() > 0.85


def test_the_sky_is_far_and_nothing_below_the_horizon_is_sky():
    grey = np.full((100, 200), 90, np.uint8)
    grey[:40] = 250
    grey[10:40, 80:90] = 60
    grey[70:80, 50:100] = 250
    sky = sky_mask(grey, (100, 50))
    assert sky[:36, :70].all() and not sky[15:40, 82:88].any() and not sky[50:].any()


def test_a_white_wall_that_reaches_the_ground_is_no_sky():
    grey = np.full((100, 200), 90, np.uint8)
    grey[:70, :76] = 250
    grey[:40, 90:] = 250
    sky = sky_mask(grey, (100, 50))
    assert not sky[:, :86].any() and sky[:36, 94:].all()


@pytest.fixture(scope="module")
def street() -> SimulatedStreet:
    street = SimulatedStreet(SimulationOptions(frames=250, seed=702, width=312, height=96))
    street.render = functools.cache(street.render)
    return street


def _measured(street, index, neighbours, error=None):
    T = np.linalg.inv(street.T_world_camera[neighbours]) @ street.T_world_camera[index]
    if error is not None:
        T = error @ T
    grey = [street.render(k)[..., 1].copy() for k in (index, *neighbours)]
    return measure(grey[0], grey[1:], street.K, T, fine=True)


@pytest.mark.parametrize("index", [40, 120])
def test_depth_is_metric_and_its_sigma_tells_where_it_is_known(street, index):
    inverse_depth, sigma = _measured(street, index, [index + k for k in (-4, -2, -1, 1, 2, 4)])
    truth = street.depth(index)
    known = np.isfinite(sigma) & (truth > 0) & (truth < 80) & (sigma < 0.2 * inverse_depth)
    assert known.mean() > 0.3
    error = np.abs(inverse_depth[known] * truth[known] - 1)
    assert np.median(error) < 0.04


def test_wrong_poses_leave_little_that_seems_known(street):
    turned = np.eye(4)
    turned[:3, :3] = np.array(
        [[1, 0, 0.0], [0, np.cos(0.02), -np.sin(0.02)], [0, np.sin(0.02), np.cos(0.02)]]
    )
    neighbours = [120 + k for k in (-4, -2, -1, 1, 2, 4)]
    (_, right), (_, wrong) = (
        _measured(street, 120, neighbours),
        _measured(street, 120, neighbours, turned),
    )
    assert np.isfinite(wrong).mean() < 0.5 * np.isfinite(right).mean()


def test_a_flow_made_from_a_depth_gives_that_depth_back():
    K = np.array([[240, 0, 208], [0, 240, 60], [0, 0, 1.0]])
    T = np.eye(4)
    T[:3, 3] = [0.1, -0.05, -1.0]
    inverse_depth = np.full((128, 416), 1 / 12, np.float32)
    p = rays(128, 416, K)
    moved = p + inverse_depth[..., None] * T[:3, 3].astype(np.float32)
    flow = np.stack([240 * (moved[..., k] / moved[..., 2] - p[..., k]) for k in range(2)], axis=-1)
    got, sigma, off_line_px = triangulate(flow.astype(np.float32), T, K)
    away = np.hypot(p[..., 0] + 0.1, p[..., 1] - 0.05) > 0.1  # from the focus of expansion
    np.testing.assert_allclose(got[away], 1 / 12, rtol=2e-3)
    assert off_line_px.max() < 0.02 and sigma[away].max() < sigma.max()


def test_a_lone_outlier_is_left_out_and_one_view_alone_is_not_believed():
    values = np.array([0.1, 0.101, 0.5, 0.1], np.float32).reshape(4, 1, 1) * np.ones(
        (4, 1, 2), np.float32
    )
    sigmas = np.full((4, 1, 2), 0.002, np.float32)
    sigmas[:3, 0, 1] = np.inf
    inverse_depth, sigma = combine(values, sigmas)
    assert inverse_depth[0, 0] == pytest.approx(0.1003, rel=1e-2)
    assert np.isfinite(sigma[0, 0]) and np.isinf(sigma[0, 1])
