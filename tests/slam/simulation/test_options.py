import numpy as np
import pytest

from slam.simulation.options import draw_variety


def test_varieties_cover_streets_and_cameras():
    drawn = [draw_variety(seed, lone_road=True) for seed in range(300)]
    assert {one.kind for one in drawn} == {"town", "avenue", "country", "motorway"}
    for values, low, high in (
        ([one.fov_deg for one in drawn], 50.0, 110.0),
        ([one.height_m for one in drawn], 0.5, 2.5),
        ([np.rad2deg(one.roll) for one in drawn], -2.0, 2.0),
        ([one.hills[0] for one in drawn], 0.0, 0.1),
    ):
        assert (
            low <= min(values) < low + 0.1 * (high - low)
            and high - 0.1 * (high - low) < max(values) <= high
        )
    assert 0.1 < np.mean([one.bonnet > 0.0 for one in drawn]) < 0.4
    assert all(draw_variety(seed, lone_road=False).kind != "motorway" for seed in range(60))


def test_a_camera_keeps_its_field_of_view_when_its_image_is_shrunk():
    one = next(
        one for one in (draw_variety(seed, True) for seed in range(50)) if one.aspect is not None
    )
    K = one.camera(416, 128).K
    assert 2.0 * np.rad2deg(np.arctan(208.0 / K[0, 0])) == pytest.approx(one.fov_deg)
    assert K[1, 1] / K[0, 0] == pytest.approx(one.aspect * 128 / 416)
