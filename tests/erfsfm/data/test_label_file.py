"""Labels as small pictures."""

import numpy as np
import pytest

from erfsfm.data.label_file import decode, encode


def measured(sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """A road that comes nearer towards the lower edge."""
    inverse_depth = np.tile(np.geomspace(0.005, 0.4, 48)[:, None], 64)
    return (inverse_depth * np.exp(-sigma)).astype(np.float32), (
        inverse_depth * np.exp(sigma)
    ).astype(np.float32)


@pytest.mark.parametrize("sigma", [0.01, 0.037, 0.13, 0.5])
def test_values_move_by_less_than_their_sigma(sigma):
    least, most = measured(sigma)
    got_least, got_most = (bound.astype(np.float32) for bound in decode(encode(least, most)))
    moved = np.log(got_least * got_most / (least * most)) / 2
    assert np.sqrt(np.mean(moved**2)) < max(0.6 * sigma, 0.01)
    width = np.log(got_most / got_least) / np.log(most / least)
    assert (width > 0.65).all() and (width < 1.5).all()


def test_what_is_unknown_stays_unknown():
    least, most = measured(0.03)
    least[:8], most[:8] = 0, 1 / 60  # the sky
    most[20:30, :32] = np.inf  # something in front of the road
    least[30:40], most[30:40] = 0, np.inf
    got_least, got_most = decode(encode(least, most))
    assert got_least.dtype == got_most.dtype == np.float16 and got_least.shape == (48, 64)
    np.testing.assert_array_equal(got_least > 0, least > 0)
    np.testing.assert_array_equal(np.isfinite(got_most), np.isfinite(most))
    np.testing.assert_allclose(got_most[:8].astype(float), 1 / 60, rtol=0.02)
    np.testing.assert_allclose(got_least[20:30, :32].astype(float), least[20:30, :32], rtol=0.02)


def test_labels_in_half_precision_become_small_and_other_files_are_refused():
    least, most = (bound.astype(np.float16) for bound in measured(0.03))
    assert len(encode(least, most)) < least.nbytes / 4
    for data in (b"", b"no picture"):
        with pytest.raises(ValueError, match="no picture"):
            decode(data)
