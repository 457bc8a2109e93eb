"""The noise record of a pose network, its sigmas, and malformed files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from erfsfm.common.errors import CheckpointError
from erfsfm.pose_noise import NOISE_FILE, PoseNoise, pair_poses, read_pose_noise, write_pose_noise

NOISE = PoseNoise(
    frame=(0.001, 0.002, 0.003, 0.01, 0.01, 0.01),
    turn=(0.0, 0.1, 0.0, 0.2, 0.0, 0.0),
    length=(0.0, 0.0, 0.0, 0.02, 0.02, 0.05),
    disagreement=(0.0, 0.0, 1.0, 0.0, 0.0, 0.5),
    correlation=(1.0, 0.5, 0.0, 1.0, 0.5, 0.0),
    pose_sha256="abc",
    measured_on=["simulated/600[0:250]"],
    pairs=990,
)


def moved(z: float) -> np.ndarray:
    T = np.eye(4)
    T[2, 3] = z
    return T


def test_a_pair_measured_by_two_snippets_is_one_measurement_of_both_directions() -> None:
    snippets = [
        (1, (0, 2), np.stack([moved(2.0), moved(-2.0)]), np.array([0.3, 0.5])),
        (2, (1, 3), np.stack([moved(2.2), moved(-2.0)]), np.array([0.7, 0.4])),
    ]
    pairs = {(pair.first, pair.last): pair for pair in pair_poses(snippets)}
    assert pairs.keys() == {(0, 1), (1, 2), (2, 3)}
    assert [pairs[k, k + 1].measurements for k in range(3)] == [1, 2, 1]
    np.testing.assert_allclose(pairs[1, 2].T_first_last, moved(2.1))
    np.testing.assert_allclose(pairs[2, 3].T_first_last, moved(2.0))
    frames, turn, length, differ, residual = pairs[1, 2].features
    np.testing.assert_allclose(frames, 1)
    np.testing.assert_allclose(turn, 0, atol=1e-12)
    np.testing.assert_allclose(length, 2.1)
    np.testing.assert_allclose(differ, [0, 0, 0, 0, 0, 0.2], atol=1e-12)
    np.testing.assert_allclose(residual, 0.6 * np.array([1, 1, 1, 2.1, 2.1, 2.1]))  # 2 seen from 1, and 1 from 2


def test_correlated_measurements_do_not_count_as_independent() -> None:
    once, twice = (pair_poses([(1, (0, 2), np.stack([moved(2.0), moved(-2.0)]), None)] * n)[0] for n in (1, 2))
    single, both = NOISE.sigmas(once), NOISE.sigmas(twice)
    np.testing.assert_allclose(single[:3], [0.001, 0.002, 0.003])
    np.testing.assert_allclose(single[3:], np.hypot(0.01, [0.04, 0.04, 0.1]))
    np.testing.assert_allclose(both / single, np.sqrt([1, 0.75, 0.5, 1, 0.75, 0.5]))


def test_the_photometric_residual_widens_sigmas() -> None:
    noise = NOISE.model_copy(update={"residual": (0.0, 0.01, 0.0, 0.0, 0.0, 0.1)})

    def sigmas(ratio: float) -> np.ndarray:
        residuals = np.array([ratio, ratio])
        return noise.sigmas(pair_poses([(1, (0, 2), np.stack([moved(2.0), moved(-2.0)]), residuals)])[0])

    np.testing.assert_allclose(sigmas(0.0)[:3], [0.001, 0.002, 0.003])
    np.testing.assert_allclose(sigmas(0.5)[1], np.hypot(0.002, 0.005))
    np.testing.assert_allclose(sigmas(0.5)[5] ** 2 - sigmas(0.0)[5] ** 2, (0.1 * 0.5 * 2.0) ** 2)


def test_noise_file_round_trip(tmp_path: Path) -> None:
    assert read_pose_noise(tmp_path) is None
    write_pose_noise(tmp_path, NOISE)
    assert read_pose_noise(tmp_path) == NOISE


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("pairs: 990", "pairs: 0", "pairs"),
        ("- 0.001\n", "- -0.001\n", "frame.0"),
        ("format: 1", "format: 2", "format"),
        ("measured_on:", "measured_at:", "measured_"),
        ("format: 1", "format: [", "not YAML"),
    ],
)
def test_a_file_that_is_no_record_is_one_clear_line(tmp_path: Path, old: str, new: str, complaint: str) -> None:
    write_pose_noise(tmp_path, NOISE)
    path = tmp_path / NOISE_FILE
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(CheckpointError) as error:
        read_pose_noise(tmp_path)
    assert complaint in str(error.value) and "\n" not in str(error.value) and str(path) in str(error.value)
