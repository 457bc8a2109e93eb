"""Lengths by the road of a car that pitches on its springs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.frames import Ends, RelativePose
from slam.frontend.scale.road_homography import RoadStep, with_slope
from slam.frontend.visual.motion import Motion, Steps
from slam.geometry.se3 import FloatArray, invert, make

STEPS = 120
LENGTH_HEIGHTS = 0.6
AHEAD, DOWN = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])


def pitches(degrees: float) -> FloatArray:
    return np.deg2rad(degrees) * np.sin(2 * np.pi * np.arange(STEPS + 1) / 14)


def drive(pitch: FloatArray, noise_deg: float = 0.0, missing: int | None = None) -> Steps:
    """Steps straight ahead on a level road; ``noise_deg`` is that of their directions, up and down."""
    rng = np.random.default_rng(0)
    R = Rotation.from_rotvec(np.outer(pitch, [1.0, 0.0, 0.0])).as_matrix()
    T_world_camera = np.array([make(R[k], 7.0 * LENGTH_HEIGHTS * k * AHEAD) for k in range(STEPS + 1)])
    motions = []
    for k in range(STEPS):
        T_current_previous = invert(T_world_camera[k + 1]) @ T_world_camera[k]
        off = Rotation.from_rotvec([np.deg2rad(noise_deg) * rng.normal(), 0.0, 0.0]).as_matrix()
        T_current_previous[:3, 3] = off @ T_current_previous[:3, 3]
        pose = RelativePose(k, k + 1, invert(T_current_previous), np.full(6, 0.01), "essential")
        motions.append(Motion(pose, 1e-6 * np.eye(6)))
    return {motion.ends: motion for motion in motions if motion.ends[0] != missing}


def road_steps(pitch: FloatArray) -> dict[Ends, RoadStep]:
    """As the images of a level road give them to a camera that is thought to be level."""
    v, u = np.mgrid[0.11:0.6:30j, -0.3:0.3:10j]
    rays = np.stack([u.ravel(), v.ravel(), np.ones(300)])
    information = 600.0 * (rays * rays[1] ** 2) @ rays.T
    steps = {}
    for k in range(STEPS):
        normal = np.array([0.0, np.cos(pitch[k + 1]), -np.sin(pitch[k + 1])])
        right = information @ (LENGTH_HEIGHTS * normal)
        steps[k, k + 1] = RoadStep(LENGTH_HEIGHTS * DOWN, information, right, 0.06).along(AHEAD)
    return steps


def error(steps: dict[Ends, RoadStep]) -> float:
    """Root mean square of relative errors."""
    return float(np.sqrt(np.mean([np.log(step.length_heights / LENGTH_HEIGHTS) ** 2 for step in steps.values()])))


@pytest.mark.parametrize("degrees", [0.3, 1.0])
def test_the_path_tells_the_pitch_by_which_lengths_err(degrees: float) -> None:
    pitch = pitches(degrees)
    measured = road_steps(pitch)
    assert error(measured) > 0.02 * degrees
    assert error(with_slope(measured, drive(pitch))) < 0.3 * error(measured)


def test_noisy_directions_count_as_little_as_they_tell() -> None:
    pitch = pitches(0.3)
    measured, steps = road_steps(pitch), drive(pitch, noise_deg=1.0)
    back = invert(np.array([steps[ends].relative_pose.T_from_to for ends in measured]))[:, :3, 3]
    by_direction = {ends: measured[ends].along(-t) for ends, t in zip(measured, back, strict=True)}
    assert error(with_slope(measured, steps)) < 0.5 * error(by_direction)


def test_the_path_ends_where_a_step_is_missing() -> None:
    pitch = pitches(1.0)
    measured = road_steps(pitch)
    solved = with_slope(measured, drive(pitch, missing=60))
    assert solved.keys() == measured.keys() and solved[60, 61] is measured[60, 61]
    assert error(solved) < 0.5 * error(measured)
    assert with_slope(measured, {}) == measured
