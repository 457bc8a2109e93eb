import numpy as np
import pytest

from slam.evaluation.depth import DepthErrors

TRUTH = np.full((20, 40), 10.0, np.float32)


def errors_of(*frames: tuple[np.ndarray, ...]):
    errors = DepthErrors()
    for frame in frames:
        errors.add(*frame)
    metrics = errors.metrics()
    return metrics and metrics.tree()


def test_no_truth_gives_no_numbers():
    assert errors_of((TRUTH, np.zeros_like(TRUTH)), (TRUTH, np.full_like(TRUTH, 81.0))) is None


def test_numbers_of_a_constant_error():
    summary = errors_of((TRUTH * 1.1, TRUTH), (TRUTH * 0.7, TRUTH))
    assert summary["abs_rel"] == pytest.approx(0.2)
    assert summary["median_rel"] == pytest.approx(0.2)
    assert summary["rmse_m"] == pytest.approx(np.sqrt(5.0), rel=1e-5)
    assert (summary["a1"], summary["frames"]) == (0.5, 2)
    assert summary["coverage"] is None and summary["coverage_reason"]


def test_errors_by_range_and_by_surface():
    """At a step from 30 to 10 m two pixels on either side are of a broken surface."""
    truth = np.full((5, 400), 10.0, np.float32)
    truth[:, :100] = 30
    by_range = errors_of((np.full_like(truth, 33), truth))["by_range"]
    smooth = (98 * 0.1 + 298 * 2.3) / 396
    assert by_range == pytest.approx(
        {"10-20": 2.3, "20-40": 0.1, "broken": 1.2, "smooth": smooth}, rel=1e-5
    )


def test_correct_sigmas_cover():
    rng = np.random.default_rng(0)
    errors = np.exp(rng.normal(0, 0.05, (20, *TRUTH.shape)))
    sigma = np.full_like(TRUTH, 0.05)
    summary = errors_of(*((TRUTH * error, TRUTH, sigma) for error in errors))
    for level in (50, 90, 95):
        assert summary["coverage"][str(level)] == pytest.approx(level / 100, abs=0.02)


def test_truth_of_another_size_meets_the_nearest_pixel():
    depth = np.repeat(np.arange(1.0, 11.0, dtype=np.float32), 4)[None].repeat(8, axis=0)  # (8, 40)
    truth = np.repeat(np.repeat(depth, 2, axis=0), 2, axis=1)
    assert errors_of((depth, truth))["abs_rel"] == 0


def test_pixels_without_an_estimate_are_not_compared():
    truth = np.full((4, 4), 10, np.float32)
    depth = np.full((4, 4), 11, np.float32)
    depth[0], depth[1] = 0, np.nan
    sigma = np.full((4, 4), 0.1)
    depth[2], sigma[2] = 30, np.inf
    summary = errors_of((depth, truth, sigma))
    assert summary["abs_rel"] == pytest.approx(0.1, rel=1e-5)
    assert (summary["coverage"]["50"], summary["coverage"]["90"]) == (0.0, 1.0)


def test_an_estimate_beyond_the_range_counts_as_its_end():
    summary = errors_of((np.full_like(TRUTH, 4000.0), np.full_like(TRUTH, 64.0)))
    assert summary["abs_rel"] == pytest.approx(0.25)


def test_of_a_long_drive_evenly_spread_frames_are_held():
    summary = errors_of(*((TRUTH * (1 + k / 3000), TRUTH) for k in range(3001)))
    assert 250 <= summary["frames"] <= 500
    assert summary["abs_rel"] == pytest.approx(0.5, abs=0.01)
