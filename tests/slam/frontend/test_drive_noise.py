import numpy as np
import pytest

from slam.config import GeometryConfig
from slam.frontend.drive_noise import drive_noise, rotation_shake
from slam.se3 import from_rotation_vector

CONFIG = GeometryConfig()


def steps(turns_rad: np.ndarray) -> dict[int, np.ndarray]:
    return {k: from_rotation_vector(turn, np.array([0.0, 0.0, 1.0])) for k, turn in enumerate(turns_rad)}


def turns(shake_rad: np.ndarray, count: int = 400) -> np.ndarray:
    """A slalom, which is no shake, under white noise of three sigmas."""
    smooth = np.stack([np.zeros(count), 0.03 * np.sin(np.arange(count) / 30.0), np.zeros(count)], axis=1)
    return smooth + np.random.default_rng(0).normal(size=(count, 3)) * shake_rad


def test_shake_is_what_a_smooth_motion_does_not_explain():
    shake_rad = np.array([1e-3, 2e-4, 5e-4])
    np.testing.assert_allclose(rotation_shake(steps(turns(shake_rad))), shake_rad, rtol=0.2)
    assert rotation_shake(steps(turns(np.zeros(3)))).max() < 1e-5


def test_a_few_jolts_do_not_shake_a_drive():
    turned = turns(np.array([1e-3, 1e-3, 1e-3]))
    turned[::50] += 0.1
    np.testing.assert_allclose(rotation_shake(steps(turned)), 1e-3, rtol=0.4)


def test_gaps_are_left_out_and_few_steps_say_nothing():
    drive = steps(turns(np.full(3, 1e-3)))
    kept = {k: T for k, T in drive.items() if k % 40 != 7}
    np.testing.assert_allclose(rotation_shake(kept), 1e-3, rtol=0.3)
    np.testing.assert_array_equal(rotation_shake({k: T for k, T in drive.items() if k % 4}), 0.0)
    np.testing.assert_array_equal(rotation_shake({}), 0.0)


def test_noise_is_shares_of_shake_and_of_the_spread_of_lengths():
    drive = steps(turns(np.full(3, 1e-3)))
    noise, shake = drive_noise(drive, 0.05, CONFIG), rotation_shake(drive)
    np.testing.assert_allclose(noise.rotation, CONFIG.shake_rotation_share * shake)
    assert noise.direction == pytest.approx(CONFIG.shake_direction_share * np.linalg.norm(shake))
    assert noise.length == pytest.approx(np.hypot(CONFIG.length_floor_share, CONFIG.length_spread_share * 0.05))
    assert drive_noise(drive, 0.0, CONFIG).length == CONFIG.length_floor_share
