"""What people do to trajectories by mistake is named, and nothing is said of trajectories that are only noisy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.evaluation.mistakes import likely_mistakes
from slam.formats.trajectory import Trajectory, associate
from slam.geometry import se3
from slam.geometry.se3 import FloatArray

RATE_HZ = 10.0


def drive(
    count: int = 300, noise_m: float = 0.03, start_s: float = 0.0, rate_hz: float = RATE_HZ
) -> Trajectory:
    """A winding drive up and down hills at changing speed, looking ahead."""
    stamps = start_s + np.arange(count) / rate_hz
    t = stamps - 0.7 * np.sin(0.9 * stamps)
    heading = 0.25 * t + 0.6 * np.sin(0.31 * t)
    positions = np.column_stack(
        [25 * np.sin(0.25 * t), 3 * np.sin(0.5 * t), 40 * np.sin(0.11 * t) + 2 * t]
    )
    positions += np.random.default_rng(0).normal(0, noise_m, positions.shape)
    turns = Rotation.from_euler(
        "YXZ", np.column_stack([heading, 0.1 * np.sin(t), 0.05 * np.cos(0.7 * t)])
    )
    return Trajectory(stamps, se3.make(turns.as_matrix(), positions))


def changed(trajectory: Trajectory, T_world_camera: FloatArray, late_s: float = 0.0) -> Trajectory:
    return Trajectory(trajectory.stamps + late_s, T_world_camera)


def said(estimate: Trajectory, reference: Trajectory) -> list[str]:
    return likely_mistakes(estimate, reference, associate(estimate, reference))


def test_nothing_is_said_of_noise():
    truth = drive(noise_m=0.0)
    for noise_m in (0.0, 0.03, 1.0, 20.0):
        assert said(drive(noise_m=noise_m), truth) == []
    turned = drive().T_world_camera @ se3.from_rotation_vector(
        np.array([0.02, 0.0, 0.0]), np.zeros(3)
    )
    assert said(changed(truth, turned), truth) == []
    straight = np.tile(np.eye(4), (100, 1, 1))
    straight[:, 2, 3] = np.arange(100)
    line = Trajectory(np.arange(100.0), straight)
    noisy = straight.copy()
    noisy[:, :3, 3] += np.random.default_rng(1).normal(0, 0.1, (100, 3))
    assert said(Trajectory(np.arange(100.0), noisy), line) == []


@pytest.mark.parametrize("late_s", [3.0, -7.3, 0.4])
def test_another_clock(late_s: float):
    truth = drive(noise_m=0.0)
    (line,) = said(changed(truth, drive().T_world_camera, late_s), truth)
    assert f"{-late_s:+.2f} s" in line and "times better (0.0" in line


def test_a_clock_that_runs_faster_and_frame_numbers_that_are_late():
    truth = drive(noise_m=0.0)
    (line,) = said(Trajectory(truth.stamps * 1.2, drive().T_world_camera), truth)
    assert "run faster" in line
    late = drive().T_world_camera[np.maximum(np.arange(300) - 5, 0)]
    (line,) = said(
        Trajectory(np.arange(300.0), late, timed=False),
        replace(truth, stamps=np.arange(300.0), timed=False),
    )
    assert "frame numbers by -5" in line


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (se3.invert, "T_camera_world"),
        (lambda T: T[::-1], "reverse"),
        (lambda T: se3.make(T[:, :3, :3], T[:, :3, 3] * [1, 1, -1]), "left-handed"),
        (lambda T: se3.make(T[:, :3, :3], 1000 * T[:, :3, 3]), "millimetres"),
        (lambda T: se3.make(np.swapaxes(T[:, :3, :3], 1, 2), T[:, :3, 3]), "Transposed"),
        (
            lambda T: T @ se3.from_rotation_vector(np.array([0.0, np.pi / 2, 0.0]), np.zeros(3)),
            "90 degrees",
        ),
    ],
)
def test_what_was_done_is_named(mistake, words: str):
    truth = drive(noise_m=0.0)
    (line,) = said(changed(truth, mistake(drive().T_world_camera)), truth)
    assert words in line
    if mistake is se3.invert:
        (line,) = said(drive(), changed(truth, se3.invert(truth.T_world_camera)))
        assert words in line


def test_quaternions_in_another_order():
    truth = drive(noise_m=0.0)
    xyzw = Rotation.from_matrix(truth.T_world_camera[:, :3, :3]).as_quat()
    R = Rotation.from_quat(xyzw[:, [3, 0, 1, 2]]).as_matrix()  # w x y z, read as x y z w
    (line,) = said(changed(truth, se3.make(R, truth.positions)), truth)
    assert "w x y z" in line


def test_a_sparse_reference_is_compared_at_its_own_times():
    estimate, truth = drive(), drive(29, noise_m=0.0, start_s=0.33, rate_hz=1.0)
    ours, theirs = associate(estimate, truth)
    assert len(ours) == len(theirs) == 29
    np.testing.assert_allclose(ours.positions, theirs.positions, atol=0.15)
    assert said(estimate, truth) == []


def test_the_gain_of_an_exact_fit_is_bounded():
    truth = drive()
    (line,) = said(changed(truth, truth.T_world_camera[::-1]), truth)
    assert "fits 1000 times better" in line
