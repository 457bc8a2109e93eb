import numpy as np
import pytest

from slam.geometry import se3
from slam.simulation.geometry import FLAT, Material, Soup
from slam.simulation.options import SimulationOptions
from slam.simulation.sensors import pixel_rays
from slam.simulation.street import SimulatedStreet
from slam.simulation.surface import Surface, place_rays
from slam.simulation.variety import draw_variety

K = np.array([[100.0, 0.0, 31.5], [0.0, 50.0, 15.5], [0.0, 0.0, 1.0]])
# a camera that looks east: right is south, down is down
T_SCENE_CAMERA = se3.make(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.0, 0.0, 1.5]))


@pytest.mark.parametrize("slope", [0.0, 0.1, -0.1])
def test_depth_of_a_slope_is_that_of_hand(slope: float) -> None:
    soup = Soup(np.random.default_rng(0))
    ground = soup.instance(Material.ASPHALT, np.full(3, 0.3))
    soup.quad(np.array([0.0, -500.0, 0.0]), np.array([900.0, 0.0, 900.0 * slope]), np.array([0.0, 1000.0, 0.0]), ground)
    rays = place_rays(T_SCENE_CAMERA, pixel_rays(K, 64, 32))
    depth = Surface.of(soup.finish(FLAT)).cast(rays)["t_hit"].reshape(32, 64)
    row = np.arange(22, 32)
    expected = 1.5 / ((row - 15.5) / 50.0 + slope)  # 1.5 - depth (v - cy) / fy = slope depth
    np.testing.assert_allclose(depth[22:], np.where(expected > 0.0, expected, np.inf)[:, None].repeat(64, 1), rtol=1e-5)


def test_varieties_cover_streets_and_cameras() -> None:
    drawn = [draw_variety(seed, lone_road=True) for seed in range(300)]
    assert {one.kind for one in drawn} == {"town", "avenue", "country", "motorway"}
    for values, low, high in (
        ([one.fov_deg for one in drawn], 50.0, 110.0),
        ([one.height_m for one in drawn], 0.5, 2.5),
        ([np.rad2deg(one.roll) for one in drawn], -2.0, 2.0),
        ([one.steepness for one in drawn], 0.0, 0.1),
    ):
        assert low <= min(values) < low + 0.1 * (high - low) and high - 0.1 * (high - low) < max(values) <= high
    assert 0.1 < np.mean([one.bonnet > 0.0 for one in drawn]) < 0.4
    assert all(draw_variety(seed, lone_road=False).kind != "motorway" for seed in range(60))


def test_a_camera_keeps_its_field_of_view_when_its_image_is_shrunk() -> None:
    one = next(one for one in (draw_variety(seed, True) for seed in range(50)) if one.aspect is not None)
    K = one.intrinsics(416, 128)
    assert 2.0 * np.rad2deg(np.arctan(208.0 / K[0, 0])) == pytest.approx(one.fov_deg)
    assert K[1, 1] / K[0, 0] == pytest.approx(one.aspect * 128 / 416)


def test_sunny_streets_saturate_a_little_and_shadows_are_deep() -> None:
    shares, steepest = [], 0.0
    for seed in range(700, 706):
        street = SimulatedStreet(SimulationOptions("straight", 30, seed, 104, 32, varied=True))
        weather = street._weather
        if weather.saturated >= 0.04:
            road_in_sun = weather.sunshine * weather.sun[2] + weather.ambient
            assert 3.0 <= road_in_sun / weather.ambient <= 10.0 + 1e-6
            shares.append(np.mean([(street.render(index).image.max(axis=2) >= 254).mean() for index in (0, 15, 29)]))
        steepest = max(steepest, np.abs(np.diff(street.T_world_camera[:, 1, 3])).max())
    assert len(shares) >= 3 and 0.02 < np.mean(shares) < 0.15
    assert steepest > 0.03


def test_a_bonnet_is_a_surface_before_the_camera() -> None:
    seed = next(seed for seed in range(700, 760) if draw_variety(seed, True).bonnet > 0.1)
    street = SimulatedStreet(SimulationOptions("straight", 30, seed, 104, 32, varied=True))
    near, later = (street.depth(index)[-1, 40:64] for index in (3, 20))
    assert (near > 0.2).all() and (near < 2.1).all()
    np.testing.assert_allclose(near, later, rtol=1e-4)  # it does not move in the image
