import numpy as np

from erfsfm.receptive_field.street import street_snippet


def test_views_of_a_drive():
    views = street_snippet(3, 128, 416)
    assert [view.shape for view in views] == [(128, 416, 3)] * 3
    assert all(view.dtype == np.uint8 for view in views)
    assert all(view.std() > 20 for view in views)
    assert (views[0] != views[1]).any()
    np.testing.assert_array_equal(views[1], street_snippet(2, 128, 416, step_m=1.0)[1])


def test_the_road_moves_towards_the_camera():
    """What lay two metres away at the first frame lies one metre away at the second: twice as far below the centre."""
    first, second = street_snippet(2, 401, 401)
    focal = 0.58 * 401
    rows = [round(200 + focal * 1.65 / z) for z in (4.0, 3.0)]
    difference = first[rows[0], 150:250].astype(int) - second[rows[1], 125:275][np.linspace(17, 132, 100).astype(int)]
    assert np.abs(difference).mean() < 12 < np.abs(first[rows[0], 150:250].astype(int) - second[rows[0], 150:250]).max()
