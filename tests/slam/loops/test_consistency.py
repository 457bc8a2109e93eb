from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.frames import LOOP_SOURCE, RelativePose
from slam.geometry.se3 import FloatArray, chain, from_rotation_vector, invert
from slam.loops.consistency import Track, agreeing
from slam.loops.verification import OF_FRAMES, Loop

SIGMAS = np.repeat([np.deg2rad(0.3), 0.2], 3)


def ring(yaw_error: float = 0.0) -> FloatArray:
    """Once and a quarter round a circle of 200 frames, one metre a frame."""
    vector = np.tile([0.0, 2 * np.pi / 200 + yaw_error, 0.0], (249, 1))
    return chain(from_rotation_vector(vector, np.tile([0.0, 0.0, 1.0], (249, 1))))


def loop(earlier: int, later: int, T: FloatArray, shift: float = 0.0, inliers: int = 40) -> Loop:
    T_from_to = invert(T[earlier]) @ T[later] @ from_rotation_vector(np.zeros(3), np.array([shift, 0.0, 0.0]))
    return Loop(RelativePose(earlier, later, T_from_to, SIGMAS, LOOP_SOURCE), inliers, 0.5)


def test_loops_of_one_stretch_support_each_other_despite_drift() -> None:
    true = [loop(k, 200 + k, ring()) for k in range(0, 40, 4)]
    kept, refused = agreeing(true, Track.of_drive(ring(yaw_error=0.0005)), OF_FRAMES)
    assert len(kept) == 10 and refused == []


def test_a_contradicted_loop_is_refused() -> None:
    true = [loop(k, 200 + k, ring()) for k in range(0, 40, 4)]
    kept, refused = agreeing([*true, loop(6, 206, ring(), shift=8.0)], Track.of_drive(ring()), OF_FRAMES)
    assert [k.ends for k in kept] == [k.ends for k in true]
    assert [r.from_index for r in refused] == [6] and "contradicted by 7 of 7" in refused[0].reason


def test_a_loop_without_support_needs_many_inliers() -> None:
    for inliers, expected in ((40, 0), (300, 1)):
        kept, refused = agreeing([loop(5, 205, ring(), inliers=inliers)], Track.of_drive(ring()), OF_FRAMES)
        assert len(kept) == expected and len(kept) + len(refused) == 1
    assert "lacks support" in agreeing([loop(5, 205, ring())], Track.of_drive(ring()), OF_FRAMES)[1][0].reason


def test_loops_that_move_the_trajectory_too_far_are_refused() -> None:
    far = [loop(k, 100 + k, ring(), shift=-60.0, inliers=300) for k in range(0, 40, 4)]
    kept, refused = agreeing(far, Track.of_drive(ring()), OF_FRAMES)
    assert kept == [] and all("corrects the odometry by more than 30% of" in r.reason for r in refused)


def test_a_loop_between_maps_may_not_contradict_the_motion_between_them() -> None:
    """Two maps of one drive: where odometry relates them, a loop is bound by it, else by other loops alone."""
    track = Track.of_drive(ring())
    maps = (track.frames >= 150).astype(np.intp)
    far = [loop(5, 205, ring(), shift=-90.0, inliers=300)]
    kept, (refused,) = agreeing(far, replace(track, maps=maps), OF_FRAMES)
    assert kept == [] and "corrects the odometry" in refused.reason
    unsure = track.path + 300.0 * maps
    assert len(agreeing(far, replace(track, maps=maps, path=unsure), OF_FRAMES)[0]) == 1
    assert len(agreeing(far, replace(track, maps=maps, worlds=maps), OF_FRAMES)[0]) == 1
