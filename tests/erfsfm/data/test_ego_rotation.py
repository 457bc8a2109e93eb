import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from erfsfm.data.ego_rotation import relative_rotation, source_rotations
from slam.sequences.simulated import SimulatedStreet, SimulationOptions


@pytest.fixture(scope="module")
def street() -> SimulatedStreet:
    return SimulatedStreet(SimulationOptions(frames=250, seed=702))


def test_rotation_of_a_street_is_within_a_third_of_a_degree(street):
    errors = []
    for k in range(0, 240, 24):
        R_first_second = relative_rotation(street.render(k).image, street.render(k + 1).image, street.K)
        assert R_first_second is not None
        true = (np.linalg.inv(street.T_world_camera[k]) @ street.T_world_camera[k + 1])[:3, :3]
        errors.append(np.rad2deg(Rotation.from_matrix(R_first_second.T @ true).magnitude()))
    assert np.median(errors) < 0.15 and max(errors) < 0.7


def test_a_camera_at_rest_does_not_turn_and_a_blank_wall_says_nothing(street):
    image = street.render(0).image
    np.testing.assert_array_equal(relative_rotation(image, image, street.K), np.eye(3))
    blank = np.full_like(image, 127)
    assert relative_rotation(blank, blank, street.K) is None


def test_steps_chain_to_every_source():
    turns = Rotation.from_rotvec(np.random.default_rng(0).normal(scale=0.1, size=(5, 3))).as_matrix()
    steps = [turns[k].T @ turns[k + 1] for k in range(4)]
    rotations = source_rotations(steps, mirrored=False)
    for row, source in enumerate((0, 1, 3, 4)):
        np.testing.assert_allclose(rotations[row], turns[source].T @ turns[2], atol=1e-6)


def test_a_gap_spoils_only_the_sources_behind_it():
    steps = [None, np.eye(3), np.eye(3), np.eye(3)]
    known = np.isfinite(source_rotations(steps, mirrored=False)).all(axis=(1, 2))
    np.testing.assert_array_equal(known, [False, True, True, True])


def test_a_mirrored_drive_turns_the_other_way():
    left = Rotation.from_rotvec([0.02, 0.3, 0.05]).as_matrix()
    mirrored = source_rotations([left, np.eye(3)], mirrored=True)[0]
    np.testing.assert_allclose(Rotation.from_matrix(mirrored).as_rotvec(), [0.02, -0.3, -0.05], atol=1e-6)
