from __future__ import annotations

import numpy as np
import pytest

from slam.frontend.keyframes.reduced_system import Part, solve_sum


def chain(cameras: int) -> list[Part]:
    """Each camera shares points with the next three, the last with the first, too."""
    rng = np.random.default_rng(3)
    groups = [np.arange(k, min(k + 4, cameras)) for k in range(cameras)] + [np.array([0, cameras - 1])]
    factors = [rng.normal(size=(6 * len(group), 6 * len(group))) for group in groups]
    return [(group, A @ A.T) for group, A in zip(groups, factors, strict=True)]


@pytest.mark.parametrize("cameras", [20, 200], ids=["dense", "sparse"])
def test_the_sum_of_the_parts_is_solved(cameras: int) -> None:
    parts = chain(cameras)
    S = np.zeros((cameras, 6, cameras, 6))
    for group, part in parts:
        S[group[:, None], :, group[None]] += part.reshape(len(group), 6, len(group), 6).transpose(0, 2, 1, 3)
    side = np.random.default_rng(4).normal(size=(cameras, 6))
    found = solve_sum(parts, side)
    assert found is not None
    np.testing.assert_allclose(S.reshape(6 * cameras, -1) @ found.ravel(), side.ravel(), atol=1e-8)


@pytest.mark.parametrize("cameras", [20, 200], ids=["dense", "sparse"])
def test_a_camera_that_nothing_holds_is_singular(cameras: int) -> None:
    parts = [(group, part) for group, part in chain(cameras) if cameras // 2 not in group]
    assert solve_sum(parts, np.ones((cameras, 6))) is None
