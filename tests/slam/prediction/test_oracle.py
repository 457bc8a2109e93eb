"""The oracle gives true depth and poses with errors of the given size."""

import numpy as np
import pytest
from oracle import OracleNoise, OraclePredictor

from slam.frames import Frame, Predictor
from slam.geometry import se3

IMAGE = np.zeros((40, 60, 3), np.uint8)


def truth(count: int = 20) -> np.ndarray:
    step = se3.from_rotation_vector(np.array([0.0, 0.02, 0.0]), np.array([0.0, 0.0, 1.0]))
    return se3.chain(np.tile(step, (count - 1, 1, 1)))


def frames(start: int, count: int = 5) -> list[Frame]:
    return [Frame(k, 0.1 * k, IMAGE) for k in range(start, start + count)]


def depth_of(index: int) -> np.ndarray:
    return np.full((40, 60), 10.0 + index, np.float32)


def test_without_noise_outputs_are_true_in_the_unscaled_unit():
    oracle: Predictor = OraclePredictor(truth(), depth_of, unscaled_factor=0.5)
    assert oracle.sources == 4
    snippet = oracle.snippet(frames(3))
    assert (snippet.target, snippet.sources) == (5, (3, 4, 6, 7))
    for source, T_source_target in zip(snippet.sources, snippet.T_source_target, strict=True):
        expected = se3.invert(truth()[source]) @ truth()[5]
        expected[:3, 3] *= 0.5
        np.testing.assert_allclose(T_source_target, expected, atol=1e-12)
    depth = oracle.depth(frames(3)[0])
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, 6.5)


def test_noise_depends_on_seed_and_frame_but_not_on_the_order_of_calls():
    noise = OracleNoise(0.01, 0.1, scale_drift_sigma=0.01, depth_relative_sigma=0.1, seed=3)
    one, other = OraclePredictor(truth(), depth_of, noise), OraclePredictor(truth(), depth_of, noise)
    forward = [one.snippet(frames(k)).T_source_target for k in range(10)]
    one_depth = [one.depth(frames(k)[0]) for k in range(10)]
    for k in reversed(range(10)):
        np.testing.assert_array_equal(other.depth(frames(k)[0]), one_depth[k])
        np.testing.assert_array_equal(other.snippet(frames(k)).T_source_target, forward[k])
    assert not np.array_equal(one_depth[0] / depth_of(0), one_depth[1] / depth_of(1))
    changed = OraclePredictor(truth(), depth_of, OracleNoise(0.01, 0.1, 0.01, 0.1, seed=4))
    assert not np.array_equal(changed.snippet(frames(0)).T_source_target, forward[0])


def test_noise_has_the_given_size():
    oracle = OraclePredictor(truth(400), depth_of, OracleNoise(0.01, 0.1, depth_relative_sigma=0.05))
    T = truth(400)
    rotations, translations, depths = [], [], []
    for k in range(300):
        snippet = oracle.snippet(frames(k))
        measured = snippet.T_source_target[1]  # one frame before the target
        error = se3.invert(se3.invert(T[k + 1]) @ T[k + 2]) @ measured
        rotations.append(float(se3.rotation_angle(error[:3, :3])) ** 2 / 3)
        translations.append((error[:3, 3] ** 2).mean())
        depths.append(np.log(oracle.depth(frames(k)[0]) / depth_of(k))[::20, ::20].ravel())
    assert np.sqrt(np.mean(rotations)) == pytest.approx(0.01, rel=0.1)
    assert np.sqrt(np.mean(translations)) == pytest.approx(0.1, rel=0.1)
    assert 0.02 < np.std(depths) < 0.06


def test_scale_drift_is_common_to_depth_and_motion():
    oracle = OraclePredictor(truth(), depth_of, OracleNoise(scale_drift_sigma=0.05))
    ratios = [
        float(oracle.depth(frames(k)[2])[0, 0] / depth_of(k + 2)[0, 0])
        / np.linalg.norm(oracle.snippet(frames(k)).T_source_target[1, :3, 3])
        for k in range(10)
    ]
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-5)
