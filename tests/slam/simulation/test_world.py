import numpy as np
import pytest

from slam.frames import Intrinsics
from slam.geometry import se3
from slam.simulation.geometry import FLAT
from slam.simulation.shapes import Site
from slam.simulation.world import Surface, place_rays

CAMERA = Intrinsics(64, 32, 100.0, 50.0, 31.5, 15.5)
# a camera that looks east: right is south, down is down
T_SCENE_CAMERA = se3.make(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.0, 0.0, 1.5])
)


@pytest.mark.parametrize("slope", [0.0, 0.1, -0.1])
def test_depth_of_a_slope_is_that_of_hand(slope: float):
    site = Site(np.random.default_rng(0))
    ground = site.instance("asphalt", np.full(3, 0.3))
    site.quad(
        np.array([0.0, -500.0, 0.0]),
        np.array([900.0, 0.0, 900.0 * slope]),
        np.array([0.0, 1000.0, 0.0]),
        ground,
    )
    rays = place_rays(
        T_SCENE_CAMERA, CAMERA.rays(CAMERA.pixel_grid()).reshape(-1, 3).astype(np.float32)
    )
    depth = Surface(site.finish(FLAT)).cast(rays)["t_hit"].reshape(32, 64)
    row = np.arange(22, 32)
    expected = 1.5 / ((row - 15.5) / 50.0 + slope)  # 1.5 - depth (v - cy) / fy = slope depth
    np.testing.assert_allclose(
        depth[22:], np.where(expected > 0.0, expected, np.inf)[:, None].repeat(64, 1), rtol=1e-5
    )
