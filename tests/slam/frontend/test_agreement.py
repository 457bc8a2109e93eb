"""Sources that contradict the images are told from those that agree."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from erfsfm.common.command_line import Terminal
from slam.frames import Intrinsics, RelativePose
from slam.frontend import agreement
from slam.frontend.drive import Drive, Segment
from slam.frontend.lidar_odometry import LidarPath, lidar_steps
from slam.frontend.measured import Measured
from slam.frontend.self_calibration import FoundCamera
from slam.frontend.visual.depth_error import DepthError
from slam.frontend.visual.motion import Motion
from slam.geometry import se3
from slam.runtime.errors import Failed

FRAMES = 40
CAMERA = Intrinsics(416, 128, 240.0, 240.0, 207.5, 63.5)
TURNS = np.column_stack([np.zeros(FRAMES), np.full(FRAMES, 0.02), np.zeros(FRAMES)])
STEPS = se3.from_rotation_vector(TURNS, np.tile([0.0, 0.0, 0.9], (FRAMES, 1)))
SWAPPED = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def noisy(T: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(0)
    return T @ se3.from_rotation_vector(
        rng.normal(0, 1e-3, (len(T), 3)), rng.normal(0, 0.02, (len(T), 3))
    )


@pytest.mark.parametrize(
    ("made", "least"),
    [
        (noisy, 0),
        (lambda T: np.tile(np.eye(4), (len(T), 1, 1)), agreement.DOUBTFUL),  # the same scan always
        (lambda T: SWAPPED @ T @ se3.invert(SWAPPED), agreement.WRONG),
        (se3.invert, agreement.WRONG),  # the drive backwards
    ],
)
def test_lidar_is_compared_with_the_steps_of_the_images(made, least):
    motions = {
        (k, k + 1): Motion(
            RelativePose(k, k + 1, T, np.full(6, 0.01), "essential"), 1e-4 * np.eye(6)
        )
        for k, T in enumerate(STEPS)
    }
    path = LidarPath(np.arange(FRAMES + 1), se3.chain(made(STEPS)))
    found = agreement.of_steps("lidar", lidar_steps(path), motions)
    assert found is not None and found.sigmas > least
    assert least or found.sigmas < 1


@pytest.mark.parametrize(
    ("implied", "stated", "is_wrong"),
    [
        (1.6, 1.65, False),
        (1650.0, 1.65, True),
        (0.0, 1.65, True),
        (0.0, None, True),
        (12.0, None, False),
    ],
)
def test_lengths_are_compared_with_the_camera_height(implied, stated, is_wrong):
    found = agreement.of_height("scale.mode=known", implied, stated, 0.02)
    assert found.is_wrong == is_wrong and (is_wrong or found.sigmas < agreement.DOUBTFUL)


def test_disparity_that_is_read_as_depth_is_doubtful():
    true = np.exp(np.random.default_rng(0).uniform(np.log(4), np.log(40), 400))
    right, inverse = (
        DepthError().with_step(learned, 1 / true, 0.0 * true, 1.0) for learned in (true, 40 / true)
    )
    assert agreement.of_depth("png:depth", DepthError()) is None
    sigmas = [
        found.sigmas
        for error in (right, inverse)
        if (found := agreement.of_depth("png:depth", error))
    ]
    assert sigmas[0] < 1 and sigmas[1] > agreement.DOUBTFUL


def driven(
    support: float = 0.7,
    on_road: int = FRAMES,
    segments: int = 1,
    contradicted: int = 0,
    leap: float = 0.1,
    aside: int = 0,
    weak: int = 0,
    focal_sigma: float = 0.0,
    turned: int = 0,
) -> float:
    """The confidence of a drive by its images."""
    poses = [RelativePose(k, k + 1, T, np.full(6, 0.01), "essential") for k, T in enumerate(STEPS)]
    steps = {}
    for k, pose in enumerate(poses):
        steps[pose.ends] = Motion(pose, 1e-4 * np.eye(6), support=0.1 if k < weak else support)
    drive = Drive(
        Measured(roads=[None] * (FRAMES + 1), below_is_nearer=[k >= turned for k in range(FRAMES)]),
        steps=steps,
        road_steps=dict.fromkeys([pose.ends for pose in poses[:on_road]]),
        segments=[Segment(k, k, "another place") for k in range(segments)],
    )
    camera = replace(CAMERA, focal_sigma=focal_sigma)
    leaps = dict.fromkeys([pose.ends for pose in poses[:contradicted]], leap)
    found = agreement.of_images(drive, camera, leaps, needs_road=True)
    T_steps = STEPS.copy()
    T_steps[:aside, :3, 3] = [0.9, 0.0, 0.0]
    sure = agreement.confidence(
        [*found, agreement.of_directions(se3.chain(T_steps))], is_metric=True, is_carried=False
    )
    assert isinstance(sure, float)
    return sure


@pytest.mark.parametrize(
    "doubtful",
    [
        {"support": 0.2},
        {"on_road": 10},
        {"segments": 2},
        {"contradicted": 2},
        {"aside": 8},
        {"weak": 10},
        {"focal_sigma": 0.1},
        {"turned": 35},
    ],
    ids=str,
)
def test_a_drive_whose_images_are_unlike_those_of_good_drives_is_doubtful(doubtful):
    assert driven(**doubtful) < 0.5 < 0.9 < driven(weak=8)


def test_the_speed_of_a_vehicle_does_not_leap(caplog):
    assert driven(contradicted=1, leap=-np.log(2.0)) < 0.02 < driven(contradicted=1)
    assert "leaps by a factor of 2.0, so the unit holds to 35 %" in caplog.text


def found(ratio: float, sigma: float = 0.03) -> FoundCamera:
    """A camera whose focal length is so many times that of `CAMERA`, by windows."""
    focal = ratio * CAMERA.focal_half_widths
    return FoundCamera(focal, (0.0, 0.0), (0.0, 0.0), sigma, 6, 60.0)


def test_a_stated_focal_length_is_contradicted_beyond_three_sigmas_alone():
    said = agreement.of_focal_length(found(1.15), CAMERA)
    assert said is not None and said.sigmas > 3.0
    assert "276 px" in said.figure and "try --camera auto" in said.figure
    for agreeing in (found(1.08), found(1.5, sigma=0.35)):
        assert agreement.of_focal_length(agreeing, CAMERA) is None
    guess = agreement.of_focal_length(found(1.08), replace(CAMERA, focal_sigma=0.1))
    assert guess is not None and guess.sigmas == 3.0 and guess.figure == "nobody calibrated it"


@pytest.mark.parametrize(("sigma", "most"), [(0.03, 0.75), (0.06, 0.43), (0.35, 0.08)])
def test_an_uncertain_focal_length_stretches_the_road(sigma, most):
    sure = agreement.confidence([], is_metric=True, is_carried=False, focal_sigma=sigma)
    assert sure == pytest.approx(most, abs=0.02)


@pytest.mark.parametrize(("is_metric", "is_carried"), [(False, False), (True, True)])
def test_without_metres_and_of_a_carried_camera_no_number_is_said(is_metric, is_carried):
    assert isinstance(agreement.confidence([], is_metric, is_carried), Failed)


@pytest.mark.parametrize(("sigmas", "drift"), [(3.5, 0.0), (0.0, 0.035)])
def test_a_shape_is_doubtful_by_contradictions_and_by_its_drift(sigmas, drift):
    said = [agreement.Agreement("gaps", sigmas, "")]
    assert agreement.shape_confidence(said, drift) < 0.5 < agreement.shape_confidence([], 0.01)


def test_noise_of_creeping_steps_does_not_point_aside():
    poses = np.tile(np.eye(4), (600, 1, 1))
    poses[:, 0, 3] = np.random.default_rng(0).normal(0.0, 0.005, 600)
    poses[:, 2, 3] = 0.01 * np.arange(600)
    assert agreement.of_directions(poses).sigmas < agreement.DOUBTFUL


def test_two_contradictions_are_two_warnings(monkeypatch, capsys):
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    Terminal(logging.WARNING)
    for each in (
        agreement.Agreement("lidar", 3.0, "50 % off"),
        agreement.Agreement("GPS", 4.0, "far"),
    ):
        each.said()
    assert "lidar contradicts" in (said := capsys.readouterr().err) and "GPS contradicts" in said


def test_a_frame_without_a_motion_has_no_support():
    pose = RelativePose(0, 1, STEPS[0], np.full(6, 0.01), "essential")
    drive = Drive(Measured(roads=[None] * 3), {(0, 1): Motion(pose, support=0.7)})
    assert drive.support is not None and drive.support.tolist() == [0.7, 0.7, 0.0]
