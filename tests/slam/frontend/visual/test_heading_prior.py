import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.frontend.visual.epipolar import UnitRelativePose
from slam.frontend.visual.heading_prior import HeadingPrior

LEAST = np.deg2rad(0.35)
STEPS = 150
# errors of yaw and of the sideways direction, bound together as corners bind them
YAW, ASIDE, BOUND = np.deg2rad(0.05), np.deg2rad(1.5), -0.8


def covariance() -> np.ndarray:
    C = np.diag(np.square([1e-4, YAW, 1e-4, ASIDE, 1e-4, 1e-6]))
    C[1, 3] = C[3, 1] = BOUND * YAW * ASIDE
    return C


def drive(seed: int, follows: float, loose: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors of yaw ``(STEPS,)`` before and after; directions follow turns and stray by ``loose`` radians."""
    rng = np.random.default_rng(seed)
    heading_prior = HeadingPrior(LEAST)
    before, after = np.zeros(STEPS), np.zeros(STEPS)
    for k in range(STEPS):
        yaw = np.deg2rad(4.0) * np.sin(k / 12.0)
        aside = follows * yaw + loose * rng.normal()
        errors = rng.multivariate_normal([0.0, 0.0], covariance()[np.ix_([1, 3], [1, 3])])
        measured = UnitRelativePose(turned(yaw + errors[0]), towards(aside + errors[1]))
        joined, left = heading_prior.fused(measured, covariance())
        before[k] = errors[0]
        after[k] = Rotation.from_matrix(joined.R_current_previous).as_rotvec()[1] - yaw
        assert np.linalg.norm(joined.direction) == pytest.approx(1.0)
        assert (np.linalg.eigvalsh(left) > -1e-15).all()
        assert left[1, 1] <= covariance()[1, 1] * (1 + 1e-9)
    return before, after


def turned(yaw: float) -> np.ndarray:
    return Rotation.from_rotvec([0.0, yaw, 0.0]).as_matrix()


def towards(aside: float) -> np.ndarray:
    return np.array([np.sin(aside), 0.0, -np.cos(aside)])


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


def test_a_vehicle_that_follows_its_turns_is_turned_more_truly():
    """A direction wholly known would leave ``sqrt(1 - 0.8 ** 2)`` of the error of yaw; it strays by 0.3 degrees."""
    for seed in range(3):
        before, after = drive(seed, follows=-0.5, loose=np.deg2rad(0.3))
        assert rms(after[50:]) < 0.75 * rms(before[50:])


def test_a_camera_that_goes_anywhere_is_left_alone():
    for seed in range(3):
        before, after = drive(seed, follows=0.0, loose=0.3)
        assert rms(after[50:]) == pytest.approx(rms(before[50:]), rel=0.03)


def test_the_first_steps_are_as_measured():
    before, after = drive(0, follows=-0.5, loose=0.0)
    np.testing.assert_allclose(after[:20], before[:20], atol=1e-12)
    assert (np.abs(after[20:] - before[20:]) > 1e-9).all()


def test_reversing_is_no_error():
    heading_prior = HeadingPrior(LEAST)
    for _ in range(40):
        heading_prior.fused(UnitRelativePose(turned(0.0), towards(0.0)), covariance())
    backwards = UnitRelativePose(turned(0.01), -towards(0.02))
    joined, left = heading_prior.fused(backwards, covariance())
    np.testing.assert_array_equal(joined.direction, backwards.direction)
    np.testing.assert_array_equal(left, covariance())


def test_a_slide_is_believed_more_than_habit():
    """Corners that are sure of a direction 20 degrees off are not bent to where the car usually goes."""
    heading_prior = HeadingPrior(LEAST)
    sure = covariance() / 25.0
    for _ in range(40):
        heading_prior.fused(UnitRelativePose(turned(0.0), towards(0.0)), sure)
    joined, _ = heading_prior.fused(UnitRelativePose(turned(0.0), towards(np.deg2rad(20.0))), sure)
    assert np.rad2deg(np.arcsin(joined.direction[0])) > 19.0
