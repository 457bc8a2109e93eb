"""Shares of factors within their own bounds, for noise that is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slam import se3
from slam.coverage import coverage, coverage_by_source, squared_bound
from slam.errors import SlamError
from slam.frames import LOOP_SOURCE, RelativePose
from slam.se3 import FloatArray

SIGMAS = np.repeat([0.003, 0.03], 3)
COUNT = 3000


def truth() -> FloatArray:
    turns = np.tile([0.0, 0.01, 0.0], (COUNT - 1, 1))
    return se3.chain(se3.from_rotation_vector(turns, np.tile([0.0, 0.0, 1.0], (COUNT - 1, 1))))


def factors(degrees: float) -> list[RelativePose]:
    """One step after the other, with errors by Student's t whose standard deviations are ``SIGMAS``."""
    rng, T = np.random.default_rng(0), truth()
    errors = SIGMAS * rng.normal(size=(COUNT - 1, 6))
    if not math.isinf(degrees):
        errors *= np.sqrt((degrees - 2) / rng.chisquare(degrees, (COUNT - 1, 1)))
    measured = se3.invert(T[:-1]) @ T[1:] @ se3.from_rotation_vector(errors[:, :3], errors[:, 3:])
    return [RelativePose(k, k + 1, T_k, SIGMAS, "network", degrees=degrees) for k, T_k in enumerate(measured)]


@pytest.mark.parametrize("degrees", [math.inf, 12.0, 4.0])
def test_noise_that_is_as_it_says_is_covered(degrees: float) -> None:
    shares = coverage(factors(degrees), truth(), 1.0)
    assert shares == {
        "50": pytest.approx(0.5, abs=0.03),
        "90": pytest.approx(0.9, abs=0.02),
        "95": pytest.approx(0.95, abs=0.02),
    }


def test_heavy_tails_that_are_not_told_are_seen() -> None:
    shares = coverage([replace(f, degrees=math.inf) for f in factors(4.0)], truth(), 1.0)
    assert shares["50"] > 0.65 and shares["95"] < 0.94
    shares = coverage([replace(f, degrees=4.0) for f in factors(math.inf)], truth(), 1.0)
    assert shares["50"] < 0.3


def test_bounds_by_hand() -> None:
    assert squared_bound(0.95, math.inf) == pytest.approx(12.592, abs=1e-3)
    # the 50 % quantile of F(6, 6) is 1; four of six degrees of freedom are left of the variance
    assert squared_bound(0.5, 6.0) == pytest.approx(6 * 4 / 6)
    assert squared_bound(0.9, 1e6) == pytest.approx(squared_bound(0.9, math.inf), rel=1e-4)


def test_the_scale_is_known() -> None:
    edges, metric = factors(math.inf), truth()
    shares = coverage(edges, metric, 1.0)
    metric[:, :3, 3] *= 4.0
    assert coverage(edges, metric, 0.25) == shares
    assert coverage(edges, metric, 1.0)["95"] < 0.1
    for bad in (([], 1.0), (edges, 0.0)):
        with pytest.raises(SlamError):
            coverage(bad[0], metric, bad[1])


def test_the_kind_of_factor_that_is_not_honest_is_told() -> None:
    honest = factors(math.inf)
    boasting = [replace(f, sigmas=f.sigmas / 10, source=LOOP_SOURCE) for f in honest[:100]]
    kinds = coverage_by_source(honest + boasting, truth(), 1.0)
    assert kinds.keys() == {"network", LOOP_SOURCE}
    assert kinds[LOOP_SOURCE]["factors"] == 100 and kinds[LOOP_SOURCE]["95"] < 0.2
    assert kinds["network"] == {"factors": len(honest), **coverage(honest, truth(), 1.0)}


def test_each_factor_is_judged_by_its_own_law() -> None:
    normal, heavy = factors(math.inf), [replace(f, source="essential") for f in factors(4.0)]
    together, apart = coverage(normal + heavy, truth(), 1.0), coverage_by_source(normal + heavy, truth(), 1.0)
    for level, share in together.items():
        assert share == pytest.approx(np.mean([kind[level] for kind in apart.values()]))
