"""Labels by refined learned depth against a simulated street, whose truth is exact."""

from __future__ import annotations

import cv2
import numpy as np
from labelled_street import FRAME, errors, seen, truth

from erfsfm.labels.flow_labels import NEIGHBOURS, label, measure
from erfsfm.labels.refined_labels import in_camera_heights, refined_label, shrunk

NEAR = (-1, 1, 3)


def test_more_is_known_than_by_flow_alone_and_it_is_as_right():
    network = 7 * cv2.GaussianBlur(truth(FRAME), (0, 0), 4) ** np.float32(0.9) + np.float32(
        0.05
    )  # in its own unit
    learned = in_camera_heights(network, *measure(*seen(FRAME, NEIGHBOURS)))
    assert learned is not None
    bounds = refined_label(*seen(FRAME, NEAR), learned)
    refined, known = errors(bounds, truth(FRAME))
    plain, known_by_flow = errors(label(*seen(FRAME, NEIGHBOURS)), truth(FRAME))
    assert known > known_by_flow + 0.1
    assert refined.mean() < plain.mean() + 0.005
    least, most = bounds
    both = (least > 0) & np.isfinite(most) & (truth(FRAME) > 0)
    between = (0.98 * least[both] <= truth(FRAME)[both]) & (truth(FRAME)[both] <= 1.02 * most[both])
    assert between.mean() > 0.8


def test_the_unit_of_learned_depth_may_be_off_in_a_frame():
    exact, middles = np.maximum(truth(FRAME), np.float32(0.008)), []
    for unit in (0.8, 1.0, 1.25):
        error, known = errors(
            refined_label(*seen(FRAME, NEAR), np.float32(unit) * exact), truth(FRAME)
        )
        assert known > 0.5
        middles.append(np.median(error))
    assert max(middles) < 0.02


def test_no_scale_where_flow_measures_nothing():
    blank = np.full((64, 128), 120, np.uint8)
    _, _, K, T_neighbour_target = seen(FRAME, (-1, 1))
    measured = measure(blank, [blank] * 2, K, T_neighbour_target)
    assert in_camera_heights(np.ones((64, 128), np.float32), *measured) is None


def test_a_smaller_label_is_wide_at_edges_and_unknown_where_a_pixel_is():
    least = np.full((2, 6), 0.2, np.float32)
    most = np.full((2, 6), 0.22, np.float32)
    least[:, 3], most[:, 3] = 0.02, 0.022  # a surface ten times as far in half of a block
    least[0, 5] = 0
    low, high = shrunk(least, most, 2)
    np.testing.assert_allclose([low[0, 0], high[0, 0]], [0.2, 0.22], rtol=1e-5)
    assert low[0, 1] < 0.021
    assert high[0, 1] > 0.21
    assert low[0, 2] == 0
    np.testing.assert_allclose(high[0, 2], 0.22, rtol=1e-5)
