"""What people do to trajectories by mistake, found by trying it: the error is then several times smaller.

Clocks that differ or run faster, poses of the world in the camera, rows in the reverse order, mirrored or permuted
axes, quaternions in another order, millimetres.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from slam.formats.trajectory import Trajectory
from slam.geometry import se3
from slam.geometry.robust import median, rms
from slam.geometry.se3 import FloatArray, interpolated, length_of

_BETTER = 3.0  # times; what fits by chance is nearer
_MOST_GAIN = 1000.0  # times; what is beyond is rounding
_EXACT = 1e-6  # of the extent of the path: an error that has no cause but rounding
_UNITS = {1000.0: "millimetres", 100.0: "centimetres", 0.001: "kilometres"}
_UNIT_TOLERANCE = 0.03
_LEAST_TURN_DEG = 20.0  # between two orders of axes
_LONGEST_SHIFT_S, _MOST_SHIFTS, _MOST_POSES = 60.0, 2000, 300
_LEAST_OVERLAP, _LEAST_POSES = 0.5, 10
_LEAST_ERROR_DEG = 0.02
_BETTER_THAN_SHIFT = 1.5  # times, of another rate, which no shift mends

Change = Callable[[FloatArray], FloatArray]


def _mirrored(T_world_camera: FloatArray) -> FloatArray:
    return se3.make(T_world_camera[:, :3, :3], T_world_camera[:, :3, 3] * [-1.0, 1.0, 1.0])


def _requaternioned(T_world_camera: FloatArray) -> FloatArray:
    """As if the numbers that were read as x, y, z, w were w, x, y, z."""
    xyzw = Rotation.from_matrix(T_world_camera[:, :3, :3]).as_quat()[:, [1, 2, 3, 0]]
    return se3.make(Rotation.from_quat(xyzw).as_matrix(), T_world_camera[:, :3, 3])


def _transposed(T_world_camera: FloatArray) -> FloatArray:
    return se3.make(np.swapaxes(T_world_camera[:, :3, :3], 1, 2), T_world_camera[:, :3, 3])


_OF_POSITIONS: tuple[tuple[str, Change], ...] = (
    ("is one of the two T_camera_world? With the estimate inverted it", se3.invert),
    ("is one of the two in reverse order of time? Turned round, the estimate", lambda T: T[::-1]),
    ("is the frame of one left-handed? Mirrored, the estimate", _mirrored),
)
_OF_ROTATIONS: tuple[tuple[str, Change], ...] = (
    (
        "are the quaternions of the estimate w x y z, where TUM has x y z w? Reordered, it",
        _requaternioned,
    ),
    (
        "are the rotations of one those of the world in the camera? Transposed, the estimate",
        _transposed,
    ),
)


def likely_mistakes(
    estimate: Trajectory, reference: Trajectory, pair: tuple[Trajectory, Trajectory]
) -> list[str]:
    """What was probably done to one of the trajectories, a line each; none where nothing fits much better.

    Args:
        estimate: the whole trajectory.
        reference: the whole truth.
        pair: the rows of both that belong together (`slam.formats.trajectory.associate`).
    """
    every = max(len(pair[0]) // _MOST_POSES, 1)
    T_estimate = pair[0].T_world_camera[::every]
    T_reference = pair[1].T_world_camera[::every]
    extent = float(np.std(T_reference[:, :3, 3], axis=0).max())
    if len(T_reference) < _LEAST_POSES or not extent > 0:
        return []
    as_given = _ate(T_estimate[:, :3, 3], T_reference[:, :3, 3])
    fits = [
        (_ate(change(T_estimate)[:, :3, 3], T_reference[:, :3, 3]), words)
        for words, change in _OF_POSITIONS
    ]
    best, words = min(fits)
    if estimate.timed == reference.timed:
        shift, unshifted, shifted = _clock(estimate, reference)
        rowwise = (
            _ate(estimate.positions, reference.positions)
            if len(estimate) == len(reference)
            else np.inf
        )
        if (
            rowwise * _BETTER < unshifted
            and rowwise * _BETTER_THAN_SHIFT < shifted
            and rowwise < best
        ):
            return [
                _said(
                    "does the clock of one run faster? Row by row, the estimate", unshifted, rowwise
                )
            ]
        if shifted * _BETTER < unshifted and shifted < best:
            by = f"stamps by {shift:+.2f} s" if estimate.timed else f"frame numbers by {shift:+.0f}"
            return [_said(f"a shift of the estimate's {by}", unshifted, shifted)]
    if as_given > _EXACT * extent and best * _BETTER < as_given:
        return [_said(words, as_given, best)]
    return [*_units(T_estimate, T_reference), *_rotations(T_estimate, T_reference)]


def _said(words: str, before: float, after: float, unit: str = "m") -> str:
    gain = before / max(after, before / _MOST_GAIN)
    return f"{words} fits {gain:.0f} times better ({after:.3g} {unit}, {before:.3g} as given)"


def _ate(estimate: FloatArray, reference: FloatArray) -> float:
    """Error of positions ``(N, 3)`` at 7 dof, in the reference's unit."""
    fit = se3.umeyama(reference, estimate, with_scale=True)
    return rms(np.linalg.norm(fit.apply(estimate) - reference, axis=1))


def _clock(estimate: Trajectory, reference: Trajectory) -> tuple[float, float, float]:
    """The shift of the estimate's stamps that fits best, seconds or frames, and the errors without and with it."""
    every = max(len(estimate) // _MOST_POSES, 1)
    stamps, positions = estimate.stamps[::every], estimate.positions[::every]
    unmatched = length_of(np.ptp(reference.positions, axis=0))

    def error(shift_s: float) -> float:
        times = stamps + shift_s
        inside = (times >= reference.stamps[0]) & (times <= reference.stamps[-1])
        if inside.sum() < max(_LEAST_OVERLAP * len(times), _LEAST_POSES):
            return unmatched
        truth = interpolated(times[inside], reference.stamps, reference.positions)
        return _ate(positions[inside], truth)

    most = min(_LONGEST_SHIFT_S, stamps[-1] - stamps[0])
    step = max(median(np.diff(estimate.stamps)), most / _MOST_SHIFTS)
    shifts = np.arange(-most, most + step, step)
    near = float(shifts[np.argmin([error(shift) for shift in shifts])])
    found = minimize_scalar(error, bounds=(near - step, near + step), method="bounded")
    return float(found.x), error(0.0), float(found.fun)


def _units(T_estimate: FloatArray, T_reference: FloatArray) -> list[str]:
    scale = se3.umeyama(T_reference[:, :3, 3], T_estimate[:, :3, 3], with_scale=True).scale
    for factor, unit in _UNITS.items():
        for who, size in (("estimate", scale * factor), ("reference", scale / factor)):
            if size > 0 and abs(np.log(size)) < _UNIT_TOLERANCE:
                return [f"{who}: it looks like {unit} (a scale of {scale:.4g})"]
    return []


def _rotations(T_estimate: FloatArray, T_reference: FloatArray) -> list[str]:
    """What makes the motions of the camera between rows turn as those of the reference."""

    def error(turns: FloatArray) -> float:
        return rms(np.linalg.norm(turns - truth, axis=1))

    truth, turns = _turns(T_reference), _turns(T_estimate)
    fits = [(error(_turns(change(T_estimate))), words) for words, change in _OF_ROTATIONS]
    axes, _ = Rotation.align_vectors(truth, turns)
    between_deg = np.rad2deg(axes.magnitude())
    if between_deg > _LEAST_TURN_DEG:
        words = f"have the two other axes of the camera? Turned by {between_deg:.0f} degrees, the estimate"
        fits.append((error(axes.apply(turns)), words))
    (best, words), as_given = min(fits), error(turns)
    if as_given > np.deg2rad(_LEAST_ERROR_DEG) and best * _BETTER < as_given:
        return [_said(words, float(np.rad2deg(as_given)), float(np.rad2deg(best)), "deg a step")]
    return []


def _turns(T_world_camera: FloatArray) -> FloatArray:
    """Rotation vectors ``(N - 1, 3)`` of the camera from row to row, in its own axes."""
    R = T_world_camera[:, :3, :3]
    return Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).as_rotvec()
