"""The five-frame snippet protocol, against hand values and the known scores of public trajectories."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from erfsfm.evaluation.pose_metrics import (
    SnippetErrors,
    snippet_errors,
    snippet_from_network,
    snippets_from_trajectory,
)
from slam.formats.trajectory import read_trajectory

Poses = NDArray[np.float64]


def straight(steps: list[float]) -> Poses:
    """Poses along z at the given places."""
    T = np.tile(np.eye(4), (len(steps), 1, 1))
    T[:, 2, 3] = steps
    return T


def random_poses(rng: np.random.Generator, count: int) -> Poses:
    """Random poses."""
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(size=(count, 3))
    return T


def test_a_scaled_copy_is_perfect():
    true = snippets_from_trajectory(random_poses(np.random.default_rng(1), 12))
    predicted = true.copy()
    predicted[..., :3, 3] *= np.linspace(0.1, 7.0, len(true))[:, None, None]
    errors = snippet_errors(predicted, true)
    assert errors.ate_mean == pytest.approx(0, abs=1e-14)
    assert errors.re_mean == pytest.approx(0, abs=1e-14)
    assert errors.count == 8


def test_hand_value_of_ate_is_norm_over_five_after_its_own_scale():
    # g = (0 1 2 3 4), p = (0 1 1 1 1): s = 10 / 4, residuals -1.5 -0.5 0.5 1.5, norm sqrt(5)
    errors = snippet_errors(straight([0, 1, 1, 1, 1])[None], straight([0, 1, 2, 3, 4])[None])
    assert errors.ate_mean == pytest.approx(math.sqrt(5) / 5, rel=1e-14)
    assert errors.ate_std == 0.0


def test_hand_value_of_re_counts_the_first_frame():
    true, predicted = straight([0, 1, 2, 3, 4])[None], straight([0, 1, 2, 3, 4])[None]
    for k in range(1, 5):
        predicted[0, k, :3, :3] = Rotation.from_rotvec([0.0, 0.1 * k, 0.0]).as_matrix()
    errors = snippet_errors(predicted, true)
    assert errors.re_mean == pytest.approx(1.0 / 5, rel=1e-12)


def test_paper_fidelity_averages_over_four_zero_rows():
    rng = np.random.default_rng(2)
    true, predicted = (
        snippets_from_trajectory(random_poses(rng, 30)),
        snippets_from_trajectory(random_poses(rng, 30)),
    )
    plain, paper = (
        snippet_errors(predicted, true),
        snippet_errors(predicted, true, fidelity="paper"),
    )
    assert paper.ate_mean == pytest.approx(plain.ate_mean * 26 / 30, rel=1e-12)
    assert paper.re_mean == pytest.approx(plain.re_mean * 26 / 30, rel=1e-12)
    square = (plain.ate_std**2 + plain.ate_mean**2) * 26 / 30
    assert paper.ate_std == pytest.approx(math.sqrt(square - paper.ate_mean**2), rel=1e-12)
    assert paper.count == plain.count == 26


def test_no_predicted_motion_is_scored_as_standing_still():
    errors = snippet_errors(straight([0] * 5)[None], straight([0, 3, 0, 4, 0])[None])
    assert errors == SnippetErrors(1.0, 0.0, 0.0, 0.0, 1)
    rounding = snippet_errors(
        straight([0, 3e-16, 0, 4e-16, 0])[None], straight([0, 3, 0, 4, 0])[None]
    )
    assert rounding == errors


def test_snippets_start_at_the_identity_and_hold_relative_poses():
    T_world_camera = random_poses(np.random.default_rng(3), 9)
    snippets = snippets_from_trajectory(T_world_camera)
    assert snippets.shape == (5, 5, 4, 4)
    np.testing.assert_allclose(snippets[:, 0], np.tile(np.eye(4), (5, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(
        snippets[2, 3], np.linalg.inv(T_world_camera[2]) @ T_world_camera[5], atol=1e-14
    )
    assert snippets_from_trajectory(T_world_camera[:4]).shape == (0, 5, 4, 4)


def test_network_output_becomes_the_snippet_of_the_trajectory():
    T_world_camera = random_poses(np.random.default_rng(4), 5)
    T_camera_world = np.linalg.inv(T_world_camera)
    T_source_target = (T_camera_world @ T_world_camera[2])[[0, 1, 3, 4]]
    T_first_k = snippet_from_network(T_source_target)
    np.testing.assert_allclose(T_first_k, snippets_from_trajectory(T_world_camera)[0], atol=1e-13)
    np.testing.assert_allclose(snippet_from_network(np.stack([T_source_target] * 2))[1], T_first_k)


def printed(errors: SnippetErrors) -> tuple[float, float, float]:
    return round(errors.ate_mean, 4), round(errors.ate_std, 4), round(errors.re_mean, 4)


@pytest.mark.data
@pytest.mark.parametrize(
    ("sequence", "stereo", "ahead", "mean_motion"),
    [
        ("09", (0.0142, 0.0077, 0.0007), (0.0419, 0.0223, 0.0237), (0.0338, 0.0241, 0.0250)),
        ("10", (0.0120, 0.0086, 0.0008), (0.0304, 0.0222, 0.0190), (0.0243, 0.0228, 0.0205)),
    ],
)
def test_scores_of_public_trajectories(
    data_root: Path,
    sequence: str,
    stereo: tuple[float, ...],
    ahead: tuple[float, ...],
    mean_motion: tuple[float, ...],
):
    """DF-VO's stereo-trained trajectories, and the two constant motions that every network must beat."""
    golden = data_root / "golden"
    T_world_camera = read_trajectory(golden / f"reference_{sequence}.txt").T_world_camera
    true = snippets_from_trajectory(T_world_camera)
    dfvo = snippets_from_trajectory(
        read_trajectory(golden / f"dfvo_stereo_{sequence}.txt").T_world_camera
    )
    assert printed(snippet_errors(dfvo, true)) == stereo
    assert (
        printed(snippet_errors(np.tile(straight([0, 1, 2, 3, 4]), (len(true), 1, 1, 1)), true))
        == ahead
    )
    steps = np.linalg.inv(T_world_camera[:-1]) @ T_world_camera[1:]
    step = np.eye(4)
    step[:3, :3] = Rotation.from_matrix(steps[:, :3, :3]).mean().as_matrix()
    step[:3, 3] = steps[:, :3, 3].mean(axis=0)
    constant = np.stack([np.linalg.matrix_power(step, k) for k in range(5)])
    assert printed(snippet_errors(np.tile(constant, (len(true), 1, 1, 1)), true)) == mean_motion
