"""Turned cameras: what the images show is the motion that the sample states."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from erfsfm.config import ExperimentConfig
from erfsfm.data.samples import training_sample
from erfsfm.data.turns import GREY, random_turns, turned, turned_motion
from erfsfm.geometry.camera import Camera
from erfsfm.readers.pinhole import Pinhole
from erfsfm.teacher.structure import TeacherStructure
from slam.sequences.simulation.street import SimulatedStreet, SimulationOptions

SOURCES = [0, 1, 3, 4]


@pytest.fixture(scope="module")
def street():
    """Five frames of a curve, their camera, depth of the middle one, and the motion to it."""
    world = SimulatedStreet(SimulationOptions(route="straight", frames=5, seed=710))
    frames = [world.render(k) for k in range(5)]
    (fx, _, cx), (_, fy, cy), _ = world.K
    camera = Camera.of(Pinhole(width=416, height=128, fx=fx, fy=fy, cx=cx, cy=cy))
    T = np.linalg.inv(world.T_world_camera[SOURCES]) @ world.T_world_camera[2]
    return [frame.image for frame in frames], camera, frames[2].depth, T.astype(np.float32)


def colour_errors(images, camera, depth, R_target, T_source_target):
    """Median difference in grey levels between the turned target's pixels and where each turned source shows them."""
    K = camera.K.astype(np.float64)
    v, u = np.mgrid[8:120:2, 8:408:2]
    near = depth[v, u] > 0
    v, u = v[near], u[near]
    points = R_target @ (np.linalg.inv(K) @ np.stack([u, v, np.ones_like(u)]) * depth[v, u])
    target = shown(images[2], K @ points)
    errors = []
    for image, T in zip([images[k] for k in SOURCES], T_source_target):
        source = shown(image, K @ (T[:3, :3] @ points + T[:3, 3:]))
        errors.append(float(np.nanmedian(np.abs(source - target))))
    return errors


def shown(image, pixels):
    """Grey levels at homogeneous pixels; NaN in the margin and outside."""
    grey = image.mean(axis=2)
    grey[(image == GREY).all(axis=2)] = np.nan
    u, v = pixels[:2] / pixels[2]
    return map_coordinates(grey, [v, u], order=1, cval=np.nan)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_turned_images_of_a_street_have_the_turned_motion(street, seed):
    images, camera, depth, T_source_target = street
    turns = Rotation.from_rotvec(np.radians(np.random.default_rng(seed).uniform(-1, 1, (5, 3)) * [1, 4, 1])).as_matrix()
    moved = turned(images, camera, turns)
    R_target = turns[2]
    right = colour_errors(moved, camera, depth, R_target, turned_motion(T_source_target, turns))
    wrong = colour_errors(moved, camera, depth, R_target, T_source_target)
    still = colour_errors(images, camera, depth, np.eye(3), T_source_target)
    assert np.mean(right) < 1.5 * np.mean(still) + 0.5
    assert np.mean(wrong) > 2 * np.mean(right)


def test_a_quarter_turn_by_hand():
    T = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    T[:, :3, 3] = [0, 0, -1], [0, 0, 1]
    yaw = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    moved = turned_motion(T, np.stack([np.eye(3), yaw, yaw]))
    np.testing.assert_allclose(moved[0, :3], np.c_[yaw.T, [0, 0, -1]], atol=1e-6)
    np.testing.assert_allclose(moved[1, :3], np.c_[np.eye(3), [1, 0, 0]], atol=1e-6)  # ahead is now to the right
    assert T[1, 2, 3] == 1


def test_no_turn_changes_nothing(street):
    images, camera, _, T_source_target = street
    none = np.tile(np.eye(3), (5, 1, 1))
    assert all((a == b).all() for a, b in zip(turned(images, camera, none), images))
    np.testing.assert_array_equal(turned_motion(T_source_target, none), T_source_target)


def test_the_margin_is_one_and_symmetric(street):
    images, camera, _, _ = street
    turns = Rotation.from_euler("yx", [[k, 0.5] for k in (-3, -1, 0, 2, 3)], degrees=True).as_matrix()
    margins = [(image == GREY).all(axis=2) for image in turned(images, camera, turns)]
    common = np.logical_and.reduce(margins)
    assert common[:, 0].all() and common[:, -1].all() and not common[64, 40:-40].any()
    np.testing.assert_array_equal(common, common[:, ::-1])


def test_turns_are_within_bounds_and_some_are_none():
    rng = np.random.default_rng(5)
    drawn = np.stack([random_turns(5, 4.0, rng) for _ in range(300)])
    angles = np.degrees(Rotation.from_matrix(drawn.reshape(-1, 3, 3)).as_rotvec()).reshape(300, 5, 3)
    still = (angles == 0).all(axis=(1, 2))
    assert 0.2 < still.mean() < 0.4
    yaw, others = angles[~still, :, 1], angles[~still][:, :, [0, 2]]
    assert 3.5 < np.abs(yaw).max() < 4 + 4 * 0.4
    assert np.abs(yaw.mean()) < 0.2 and np.abs(others).max() < 3


@pytest.mark.parametrize("seed", range(3))
def test_a_sample_states_the_motion_of_its_turned_images(street, seed):
    images, camera, _, T_source_target = street
    tree = {
        "data": {"flip": 0.0, "zoom": 1.0, "turn": 3.0},
        "teacher": {"views": "many", "rotation_weight": 1.0},
        "training": {"networks": "pose"},
    }
    config = ExperimentConfig.model_validate(tree)
    nothing = np.zeros((128, 416), np.float16)
    seen = TeacherStructure(T_source_target, nothing, np.full_like(nothing, np.inf))
    sample = training_sample(images, camera, seen, (0, 0), config, np.random.default_rng(seed))
    rng = np.random.default_rng(seed)
    rng.random()  # flip
    turns = random_turns(5, 3.0, rng)
    expected = turned_motion(T_source_target, turns)
    np.testing.assert_allclose(sample["T_source_target"][:, :3, :3], expected[:, :3, :3], atol=1e-6)
    first = (sample["sources"][0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    assert (first == turned(images, camera, turns)[0]).all()


def test_depth_of_turned_cameras_is_refused():
    with pytest.raises(ValueError, match=r"data\.turn needs training\.networks: pose"):
        ExperimentConfig.model_validate({"data": {"turn": 1.0}})
