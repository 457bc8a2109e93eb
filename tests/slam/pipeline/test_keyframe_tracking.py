import numpy as np
import pytest

from slam.config import SlamConfig, WindowConfig
from slam.frames import RelativePose
from slam.frontend.visual.epipolar import TriangulatedPoints
from slam.frontend.visual.motion import Motion
from slam.pipeline.keyframe_tracking import decided, is_vehicle
from slam.pipeline.observations import Observations
from slam.se3 import from_rotation_vector

POINTS = TriangulatedPoints(np.arange(1), np.ones(1), np.ones(1), np.ones(1))


def steps(count: int, scatter: float) -> Observations:
    rng = np.random.default_rng(0)
    motions = []
    for k in range(count):
        T = from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, scatter, 3))
        motions.append(Motion(RelativePose(k, k + 1, T, np.ones(6), "essential"), POINTS, np.ones(3)))
    return Observations(motions=motions)


@pytest.mark.parametrize(("count", "scatter", "vehicle"), [(60, 0.02, True), (60, 1.0, False), (20, 0.02, None)])
def test_a_vehicle_goes_the_same_way_for_a_while(count: int, scatter: float, vehicle: bool | None) -> None:
    assert is_vehicle(steps(count, scatter), WindowConfig()) is vehicle


def test_a_known_camera_height_decides() -> None:
    assert decided(SlamConfig(), 1.65).window.use == "never"
    assert decided(SlamConfig(), None).window.use == "auto"
    always = SlamConfig(window=WindowConfig(use="always"))
    assert decided(always, 1.65).window.use == "always"
