"""The cameras' linear system of a bundle adjustment: dense for a window, sparse for all keyframes of a map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from slam.geometry.se3 import FloatArray

Part = tuple[NDArray[np.int64], FloatArray]
_MOST_DENSE = 150  # cameras: each of more shares points with few others only
_SIX = np.arange(6)


def solve_sum(parts: Sequence[Part], side: FloatArray) -> FloatArray | None:
    """The solution of the sum of symmetric parts, positive definite.

    Args:
        parts: different cameras ``(c,)`` each, and what couples their unknowns ``(6c, 6c)``.
        side: the right side ``(F, 6)``.

    Returns:
        ``(F, 6)``, or None where the sum is singular.
    """
    unknowns = [(6 * cameras[:, None] + _SIX).ravel() for cameras, _ in parts]
    solve = _dense if len(side) <= _MOST_DENSE else _sparse
    solution = solve(unknowns, [part for _, part in parts], side.ravel())
    return None if solution is None else solution.reshape(-1, 6)


def _dense(unknowns: Sequence[NDArray[np.int64]], parts: Sequence[FloatArray], side: FloatArray) -> FloatArray | None:
    S = np.zeros((len(side), len(side)))
    for rows, part in zip(unknowns, parts, strict=True):
        S[np.ix_(rows, rows)] += part
    try:
        return np.asarray(cho_solve(cho_factor(S, check_finite=False), side, check_finite=False))
    except LinAlgError:
        return None


def _sparse(unknowns: Sequence[NDArray[np.int64]], parts: Sequence[FloatArray], side: FloatArray) -> FloatArray | None:
    rows = np.concatenate([np.repeat(each, len(each)) for each in unknowns])
    columns = np.concatenate([np.tile(each, len(each)) for each in unknowns])
    values = np.concatenate([part.ravel() for part in parts])
    S = csc_array((values, (rows, columns)), shape=(len(side), len(side)))
    try:
        # as a symmetric one: its pattern decides the order, and pivots stay on the diagonal
        factors = splu(S, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:
        return None
    return np.asarray(factors.solve(side))
