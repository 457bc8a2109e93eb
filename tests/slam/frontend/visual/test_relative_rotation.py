import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.frontend.visual.relative_rotation import RelativeRotation, StepRotation, smooth_rotations

SIGMA = np.deg2rad(0.02)
STEPS = 40


def small(rng: np.random.Generator, sigma: float) -> np.ndarray:
    return Rotation.from_rotvec(rng.normal(0.0, sigma, 3)).as_matrix()


def true_turns(rng: np.random.Generator) -> list[np.ndarray]:
    """A drive that turns by up to 4 degrees a step."""
    return [
        Rotation.from_euler("y", 4.0 * np.sin(0.3 * k), degrees=True).as_matrix() @ small(rng, 0.005)
        for k in range(STEPS)
    ]


def error_deg(turns: dict[int, np.ndarray], truth: list[np.ndarray]) -> float:
    """Of the whole drive's turn."""
    R, R_true = np.eye(3), np.eye(3)
    for k in range(STEPS):
        R, R_true = turns[k] @ R, truth[k] @ R_true
    return float(np.rad2deg(Rotation.from_matrix(R @ R_true.T).magnitude()))


def drive(
    bias: np.ndarray, span_noise: float, seed: int = 0
) -> tuple[dict[int, StepRotation], list[RelativeRotation], list[np.ndarray]]:
    """Steps that are turned too far by ``bias`` each, spans of two that are turned too far by no more than that."""
    rng = np.random.default_rng(seed)
    truth, off = true_turns(rng), Rotation.from_rotvec(bias).as_matrix()
    sigmas = np.full(3, SIGMA)
    turns = {k: StepRotation(off @ small(rng, 0.1 * SIGMA) @ R, sigmas) for k, R in enumerate(truth)}
    relative_rotations = [
        RelativeRotation(k, k + 2, off @ small(rng, span_noise) @ truth[k + 1] @ truth[k], sigmas)
        for k in range(STEPS - 1)
    ]
    return turns, relative_rotations, truth


def test_without_spans_steps_stay_as_they_were():
    turns, _, _ = drive(np.zeros(3), 0.0)
    kept = smooth_rotations(turns, [])
    assert all((kept[k] == turns[k].R_current_previous).all() for k in range(STEPS))


def test_true_steps_and_spans_stay_true():
    rng = np.random.default_rng(0)
    truth = true_turns(rng)
    turns = {k: StepRotation(R, np.full(3, SIGMA)) for k, R in enumerate(truth)}
    relative_rotations = [
        RelativeRotation(k, k + 2, truth[k + 1] @ truth[k], np.full(3, SIGMA)) for k in range(STEPS - 1)
    ]
    mended = smooth_rotations(turns, relative_rotations)
    for k in range(STEPS):
        np.testing.assert_allclose(mended[k], truth[k], atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_what_drags_every_step_drags_half_as_far_over_spans(axis):
    bias = SIGMA * np.eye(3)[axis]
    turns, relative_rotations, truth = drive(bias, 0.1 * SIGMA)
    before = error_deg({k: turn.R_current_previous for k, turn in turns.items()}, truth)
    assert error_deg(smooth_rotations(turns, relative_rotations), truth) < 0.65 * before


def test_a_span_that_is_far_off_is_outvoted():
    turns, relative_rotations, truth = drive(np.zeros(3), 0.1 * SIGMA)
    before = error_deg(smooth_rotations(turns, relative_rotations), truth)
    wrong = Rotation.from_euler("y", 5.0, degrees=True).as_matrix() @ relative_rotations[10].R_to_from
    relative_rotations[10] = RelativeRotation(10, 12, wrong, relative_rotations[10].sigmas)
    assert error_deg(smooth_rotations(turns, relative_rotations), truth) < before + 0.02


def test_spans_across_a_step_that_nothing_measured_say_nothing():
    turns, relative_rotations, _ = drive(np.array([SIGMA, 0.0, 0.0]), 0.1 * SIGMA)
    del turns[20]
    mended = smooth_rotations(turns, relative_rotations)
    assert set(mended) == set(turns)
    nearby = [span for span in relative_rotations if 20 not in span.steps]
    for k, R in smooth_rotations(turns, nearby).items():
        np.testing.assert_array_equal(R, mended[k])


def test_steps_alone_on_both_sides_of_a_gap_are_kept():
    turns, relative_rotations, _ = drive(np.zeros(3), 0.1 * SIGMA)
    mended = smooth_rotations({0: turns[0], 20: turns[20]}, relative_rotations)
    np.testing.assert_array_equal(mended[20], turns[20].R_current_previous)
