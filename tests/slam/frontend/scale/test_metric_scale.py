import numpy as np
import pytest

from slam import se3
from slam.config import LengthConfig, LidarConfig, ScaleConfig
from slam.frames import RelativePose
from slam.frontend.failure import MeasurementFailure
from slam.frontend.scale.metric_scale import LengthMeasurements, Scale, find_scale
from slam.frontend.scale.road_homography import RoadStep
from slam.frontend.scale.road_plane import GroundPlane, ScaleEstimate
from slam.frontend.visual.epipolar import TriangulatedPoints
from slam.frontend.visual.odometry import Motion

DOWN = np.array([0.0, 1.0, 0.0])
HEIGHT_M = 1.65
UNIT = 0.05  # unscaled lengths per metre
STEPS_M = 1.0 + 0.2 * np.sin(np.arange(60) / 6.0)
NO_STRUCTURE = TriangulatedPoints(np.zeros(0, np.int64), *(np.zeros(0) for _ in range(3)))


def measured(
    road=True, planes=True, bias: float = 1.0, lidar: int = 0, height_m: float = HEIGHT_M
) -> LengthMeasurements:
    """A straight drive; ``bias`` makes the learned road lie too near, ``lidar`` steps have scans."""
    poses = [se3.from_rotation_vector(np.zeros(3), np.array([0.0, 0.0, length])) for length in STEPS_M]
    motions = {}
    for k, T in enumerate(poses):
        unscaled = T.copy()
        unscaled[:3, 3] *= UNIT
        motions[k] = Motion(RelativePose(k, k + 1, unscaled, np.ones(6), "essential"), NO_STRUCTURE, np.zeros(3))
    plane: GroundPlane | MeasurementFailure = (
        GroundPlane(bias * HEIGHT_M * UNIT, DOWN, 1.0) if planes else MeasurementFailure("dark")
    )
    roads = {k: RoadStep(length / height_m, 0.06, DOWN) for k, length in enumerate(STEPS_M)} if road else {}
    scans = [RelativePose(k, k + 1, poses[k], np.ones(6), "lidar") for k in range(lidar)]
    return LengthMeasurements([plane] * (len(STEPS_M) + 1), motions, roads, scans)


def find(mode, measurements: LengthMeasurements, height_m: float | None = HEIGHT_M) -> Scale:
    return find_scale(mode, height_m, measurements, ScaleConfig(), LengthConfig(), LidarConfig())


@pytest.mark.parametrize(("mode", "unit_m"), [("camera-height", 1.0), ("none", HEIGHT_M), ("reference", HEIGHT_M)])
@pytest.mark.parametrize("planes", [True, False])
def test_the_road_in_the_image_overrules_the_learned_road(mode, unit_m, planes):
    scale = find(mode, measured(planes=planes, bias=0.7))
    np.testing.assert_allclose(scale.lengths * unit_m, STEPS_M, rtol=0.02)
    np.testing.assert_allclose(scale.per_frame * unit_m, 1 / UNIT, rtol=0.03)
    assert isinstance(scale.estimate, ScaleEstimate)
    assert scale.estimate.frames_used == len(STEPS_M) and scale.estimate.spread < 0.02


def test_without_a_road_in_the_image_the_learned_road_stands():
    scale = find("camera-height", measured(road=False))
    np.testing.assert_allclose(scale.lengths, STEPS_M, rtol=1e-4)
    assert isinstance(scale.estimate, ScaleEstimate)


def test_without_any_road_lengths_stay_unscaled():
    scale = find("camera-height", measured(road=False, planes=False))
    assert isinstance(scale.estimate, MeasurementFailure)
    np.testing.assert_allclose(scale.per_frame, 1.0, rtol=1e-12)
    np.testing.assert_allclose(scale.lengths, UNIT * STEPS_M, rtol=1e-6)


def test_lidar_measures_its_steps_and_the_height_for_the_others():
    """The camera is really 2 m high; nobody was told, or was told wrong."""
    for told in (None, HEIGHT_M):
        scale = find("lidar", measured(lidar=20, height_m=2.0), told)
        np.testing.assert_allclose(scale.lengths, STEPS_M, rtol=0.02)


def test_a_later_estimate_rescales_everything_and_a_refusal_nothing():
    scale = find("none", measured())
    doubled = scale.in_unit_of(ScaleEstimate(2.0, 0.1, 9))
    np.testing.assert_allclose(doubled.lengths, 2.0 * scale.lengths)
    np.testing.assert_allclose(doubled.per_frame, 2.0 * scale.per_frame)
    assert isinstance(doubled.estimate, ScaleEstimate) and doubled.estimate.frames_used == 9
    refused = scale.in_unit_of(MeasurementFailure("it stands"))
    np.testing.assert_array_equal(refused.lengths, scale.lengths)
    assert refused.estimate == MeasurementFailure("it stands")
