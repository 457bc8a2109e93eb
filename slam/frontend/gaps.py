"""A drive completed after its last frame: cuts found, gaps interpolated, rotations smoothed, and its road.

Frames without a measurement follow the constant-velocity model, with wide sigmas.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from erfsfm.common.readers.frame_range import runs
from slam.frames import Ends, RelativePose, SnippetPoses, TrackingEvent
from slam.frontend.drive import Drive
from slam.frontend.keyframes.relative_poses import NO_MAPS, KeyframePoses
from slam.frontend.measured import Measured
from slam.frontend.network_motion import calibrate_network, network_steps
from slam.frontend.road import with_slope
from slam.frontend.rotations import smooth_rotations
from slam.frontend.visual.motion import Motion, Steps
from slam.geometry.robust import median
from slam.geometry.se3 import (
    FloatArray,
    chain,
    equal_step,
    from_rotation_vector,
    invert,
    length_of,
    tangent,
)
from slam.runtime.errors import SlamError

INTERPOLATED_SOURCE = "interpolated"
# of the corners: across a cut few are found again, by chance, before a lorry half of them
_LEAST_FOUND = 0.2
_STEPS_OF_A_MOTION = 3
# the first step of a camera that stood, in steps before it stood
_LONGEST_START = 2.0
# frames without a usable image between a frozen video and the first new image
_LONGEST_DOUBT = 2
_SIGMA_FLOOR = 1e-6
_ROTATION_SIGMA_DEG = 2.0  # rotation sigma of an interpolated step, degrees
_TRANSLATION_RELATIVE_SIGMA = 0.5  # translation sigma over the length of an interpolated step


def complete_drive(
    measured: Measured,
    sources: int,
    map_poses: KeyframePoses = NO_MAPS,
    joins: Sequence[TrackingEvent] = (),
) -> Drive:
    """The drive with its gaps interpolated, its rotations smoothed, and its road by its path.

    More frames may follow: what was measured stays as it is.

    Args:
        measured: as it was collected.
        sources: frames of a snippet besides its target.
        map_poses: poses by the maps of keyframes of the drive.
        joins: events of loops that join these maps.

    Raises:
        SlamError: no snippet was measured, so there is no motion to extrapolate.
    """
    if measured.is_upside_down:
        measured = replace(measured, roads=[None] * len(measured), road_steps={})
    ends = {*measured.steps, *map_poses.steps}
    cuts = find_cuts(measured.failures, ends, {*measured.unusable, *measured.repeated})
    drive = _interpolated(measured, sources, cuts, map_poses)
    steps = smooth_rotations(drive.steps, measured.relative_rotations)
    return replace(
        drive,
        steps=steps,
        road_steps=with_slope(measured.road_steps, steps),
        events=sorted([*measured.events, *joins], key=lambda event: event.frame),
    )


def find_cuts(
    failures: Mapping[Ends, float], measured: Collection[Ends], doubtful: Collection[int]
) -> list[int]:
    """Frames that show another place than the frame before: their step failed, the steps before and after did not.

    Args:
        failures: steps that image geometry could not measure, and the share of corners that were
            found again.
        measured: steps that it measured.
        doubtful: frames that are unusable or repeat the one before.
    """
    ends = set(measured)
    cuts = []
    for (first, last), found in failures.items():
        around = {first - 1, first, last, last + 1}
        alone = last == first + 1 and {(first - 1, first), (last, last + 1)} <= ends
        if found < _LEAST_FOUND and alone and around.isdisjoint(doubtful):
            cuts.append(last)
    return cuts


def _interpolated(
    measured: Measured, sources: int, cuts: Sequence[int], map_poses: KeyframePoses
) -> Drive:
    """Steps and snippets also in the gaps, and without what was measured on interpolated frames.

    Steps over a gap are between its two ends. No snippet measures across a cut.

    Args:
        measured: as it was collected.
        sources: frames of a snippet besides its target.
        cuts: frames that show another place than the frame before.
        map_poses: poses by the maps of keyframes of the drive.

    Raises:
        SlamError: no snippet was measured, so there is no motion to extrapolate.
    """
    count = len(measured)
    snippets = measured.snippets.values()
    if not snippets:
        why = next(iter(measured.unusable.values()), "the sequence is too short")
        raise SlamError(f"no {sources + 1} usable frames in a row among {count}: {why}")
    new = set(range(count)).difference(measured.unusable, measured.repeated)
    raw, by_corners = network_steps(snippets), measured.steps
    calibration = calibrate_network(raw, _poses(by_corners), np.ones(count))
    by_network = calibration.scaled(raw)
    frozen, steps = _without_frozen(by_network, by_corners, map_poses, measured.repeated, new)
    why = "the image stands still while the camera moves"
    frames = measured.unusable | dict.fromkeys(frozen, why)
    trusted = network_steps([each for each in snippets if _is_trusted(each, frozen, cuts)])
    single = (pose for pose in _poses(steps) if pose.to_index == pose.from_index + 1)
    by_image = {pose.from_index: pose.T_from_to for pose in single}
    covered = calibration.scaled(trusted) | by_image
    # snippets of frozen images alone are still the best estimate available
    known = covered or by_network
    loose = [k for k in range(count - 1) if k not in covered]
    motion = _completed(known, loose)
    for pose in _poses(steps):  # over gaps
        over = range(*pose.ends)
        if len(over) > 1 and set(loose).issuperset(over):
            motion |= dict.fromkeys(over, equal_step(pose.T_from_to, len(over)))
    typical = median([np.linalg.norm(T[:3, 3]) for T in known.values()])
    return Drive(
        measured,
        steps,
        snippets=_filled(snippets, _completed(raw, range(count - 1)), count, sources),
        network_steps=trusted,
        interpolated=dict(sorted(frames.items())),
        gap_steps=[
            _guess(k, motion[k], max(typical, map_poses.across(k + 1) or 0.0)) for k in loose
        ],
        cuts=cuts,
        map_poses=map_poses,
    )


def _is_trusted(snippet: SnippetPoses, frozen: Collection[int], cuts: Collection[int]) -> bool:
    """Whether a snippet sees no frozen frame and does not measure across a cut."""
    span = {snippet.target, *snippet.sources}
    return span.isdisjoint(frozen) and set(cuts).isdisjoint(range(min(span) + 1, max(span) + 1))


def _guess(k: int, T_k_next: FloatArray, usual: float) -> RelativePose:
    """An interpolated step, whose sigmas are wide: by its length, or by a ``usual`` one.

    Where one map has both sides of a gap, that is all the way between them: by constant velocity many such steps would
    outvote the one pose by the map.
    """
    length = max(length_of(T_k_next[:3, 3]), usual, _SIGMA_FLOOR)
    sigmas = np.repeat([np.deg2rad(_ROTATION_SIGMA_DEG), _TRANSLATION_RELATIVE_SIGMA * length], 3)
    return RelativePose(k, k + 1, T_k_next, sigmas, INTERPOLATED_SOURCE)


def _without_frozen(
    by_network: Mapping[int, FloatArray],
    steps: Steps,
    map_poses: KeyframePoses,
    repeated: Collection[int],
    new: Collection[int],
) -> tuple[set[int], Steps]:
    """Repeated frames during which the camera moved, and the steps that remain without them.

    The length of the step to the next new image decides: short if the camera stood; the length of
    as many steps as images were repeated if it moved. A length between the two is a failed match
    over a wide baseline and is not used. Without a new image soon after the camera is assumed to
    stand.
    """
    frozen: set[int] = set()
    for first, last in runs(repeated):
        before = [
            T for k, T in by_network.items() if first - 1 - _STEPS_OF_A_MOTION <= k < first - 1
        ]
        following = next((k for k in range(last + 1, last + 2 + _LONGEST_DOUBT) if k in new), None)
        if not before or following is None:
            continue
        expected = median([np.linalg.norm(T[:3, 3]) for T in before])
        jump = steps.get((last, following))
        repeats, onward = last - first + 1, following - last
        halfway = (onward + repeats / 2) * expected
        length = map_poses.length(last, following) if jump is None else jump.length_unscaled
        if length is not None and length <= min(halfway, onward * _LONGEST_START * expected):
            continue
        still = set(range(first, last + 1))
        frozen |= still
        steps = {ends: motion for ends, motion in steps.items() if still.isdisjoint(ends)}
        if jump is not None and jump.length_unscaled > halfway:
            over_gap = Motion(replace(jump.relative_pose, from_index=first - 1))
            steps = {**steps, over_gap.ends: over_gap}
    return frozen, steps


def _poses(steps: Steps) -> list[RelativePose]:
    return [motion.relative_pose for motion in steps.values()]


def _completed(known: Mapping[int, FloatArray], steps: Collection[int]) -> dict[int, FloatArray]:
    """Motions of all steps: unknown ones are interpolated from the mean motion before them to that after them."""
    unknown = [step for step in steps if step not in known]
    if not unknown:
        return dict(known)
    numbers = np.array(sorted(known))
    motion = tangent(np.array([known[k] for k in numbers.tolist()]))
    found = np.empty((len(unknown), 6))
    for row, step in enumerate(unknown):
        after = int(np.searchsorted(numbers, step))
        parts = (
            motion[max(after - _STEPS_OF_A_MOTION, 0) : after],
            motion[after:][:_STEPS_OF_A_MOTION],
        )
        means = [part.mean(axis=0) for part in parts if len(part)]
        # of two, the nearer mean weighs more
        share = np.interp(step, numbers[max(after - 1, 0) : after + 1], range(len(means)))
        found[row] = means[0] + share * (means[-1] - means[0])
    T = from_rotation_vector(found[:, :3], found[:, 3:])
    return {**known, **dict(zip(unknown, T, strict=True))}


def _filled(
    snippets: Iterable[SnippetPoses], steps: Mapping[int, FloatArray], count: int, sources: int
) -> list[SnippetPoses]:
    """One snippet a target; missing ones are chained from single steps."""
    by_target = {snippet.target: snippet for snippet in snippets}
    T_first_camera = chain(np.array([steps[k] for k in range(count - 1)]))
    filled, half = [], sources // 2
    for target in range(half, count - sources + half):
        snippet = by_target.get(target)
        if snippet is None:
            around = [k for k in range(target - half, target - half + sources + 1) if k != target]
            T_source_target = invert(T_first_camera[around]) @ T_first_camera[target]
            snippet = SnippetPoses(target, tuple(around), T_source_target)
        filled.append(snippet)
    return filled
