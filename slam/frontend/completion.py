"""A drive completed after its last frame: gaps interpolated, rotations smoothed, segments found.

Frames without a measurement follow the constant-velocity model, with wide sigmas. Rotations of single steps are
corrected by relative rotations across several steps, where the tracking error of a corner enters half as often, and
directions by as much as their covariance with the rotation says (``docs/design/visual-front-end.md``).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from slam.frames import Ends, RelativePose, SnippetPoses, TrackingEvent, runs
from slam.frontend.drive import Drive, Segment
from slam.frontend.factors import calibrate_network, equal_step, network_steps
from slam.frontend.keyframes.relative_poses import KeyframePoses
from slam.frontend.road import with_slope
from slam.frontend.visual.motion import (
    Motion,
    RelativeRotation,
    Steps,
    path_between,
    shortest_by_start,
    triangulated,
)
from slam.geometry.se3 import FloatArray, chain, from_rotation_vector, invert, tangent
from slam.runtime.errors import SlamError

INTERPOLATED_SOURCE = "interpolated"
_STEPS_OF_A_MOTION = 3
# the first step of a camera that stood, in steps before it stood
_LONGEST_START = 2.0
# frames without a usable image between a frozen video and the first new image
_LONGEST_DOUBT = 2
_LONGEST_GAP = 30  # interpolated frames, after which the place is only guessed
_SIGMA_FLOOR = 1e-6
_ROTATION_SIGMA_DEG = 2.0  # rotation sigma of an interpolated step, degrees
_TRANSLATION_RELATIVE_SIGMA = 0.5  # translation sigma over the length of an interpolated step
_NO_MAPS = KeyframePoses()
# sigmas of single steps are widened by this: the errors of neighbouring steps are correlated
_STEP_WIDENING = 3.0
_ITERATIONS = 4
_OUTLIER_SIGMAS = 3.0
_BLOCK = np.arange(9)


def complete_drive(
    drive: Drive,
    sources: int,
    map_poses: KeyframePoses = _NO_MAPS,
    joins: Sequence[TrackingEvent] = (),
) -> Drive:
    """The drive with its gaps interpolated, its rotations smoothed, its road by its path, and its segments.

    More frames may follow: the collected drive stays as it is. ``sources`` are those of a snippet, ``map_poses`` are by
    its maps of keyframes, which loops join at ``joins``.

    Raises:
        SlamError: no snippet was measured, so there is no motion to extrapolate.
    """
    measured = {*drive.steps, *map_poses.steps}
    cuts = find_cuts(drive.failures, measured, {*drive.unusable, *drive.repeated})
    filled = interpolate_gaps(drive, sources, cuts, map_poses)
    smoothed = smooth_rotations(filled.steps, drive.relative_rotations)
    return replace(
        filled,
        motions=list(smoothed.values()),
        road_steps=with_slope(drive.road_steps, smoothed),
        segments=find_segments(len(drive), cuts, filled.interpolated, map_poses.relates),
        map_poses=map_poses,
        events=sorted([*drive.events, *joins], key=lambda event: event.frame),
    )


def find_cuts(
    failures: Sequence[tuple[int, int, str]], measured: Collection[Ends], doubtful: Collection[int]
) -> list[int]:
    """Frames that show another place than the frame before: their step failed, the steps before and after did not.

    Args:
        failures: steps that image geometry could not measure, and why.
        measured: steps that it measured.
        doubtful: frames that are unusable or repeat the one before.
    """
    ends = set(measured)
    longer = [(a, b) for a, b in ends if b - a > 1]
    cuts = []
    for first, last, _ in failures:
        around = {first - 1, first, last, last + 1}
        alone = last == first + 1 and (first - 1, first) in ends and (last, last + 1) in ends
        if alone and around.isdisjoint(doubtful) and not any(a < last <= b for a, b in longer):
            cuts.append(last)
    return sorted(set(cuts))


def find_segments(
    count: int,
    cuts: Collection[int],
    interpolated: Mapping[int, str],
    is_related: Callable[[int], bool],
) -> list[Segment]:
    """The segments of a drive of so many frames, by its cuts and its long gaps.

    ``is_related`` tells of a frame whether a map of keyframes relates the frames from it on to those before.
    """
    between = [cut for cut in cuts if not is_related(cut)]
    begins = {0: ""} | dict.fromkeys(between, "it shows another place than the frame before")
    ends = {count - 1} | {cut - 1 for cut in between}
    for first, last in runs(interpolated):
        if (
            last - first + 1 > _LONGEST_GAP
            and first > 0
            and last + 1 < count
            and not is_related(last + 1)
        ):
            ends.add(first - 1)
            begins[last + 1] = (
                f"{last - first + 1} frames before it are interpolated: {interpolated[first]}"
            )
    return [
        Segment(first, last, begins[first])
        for first, last in zip(sorted(begins), sorted(ends), strict=True)
    ]


def interpolate_gaps(
    drive: Drive, sources: int, cuts: Collection[int] = (), map_poses: KeyframePoses = _NO_MAPS
) -> Drive:
    """The drive with steps and snippets in its gaps, and without what was measured on interpolated frames.

    Steps over a gap are between its two ends. No snippet measures across ``cuts``, which show another place than the
    frame before.

    Raises:
        SlamError: no snippet was measured, so there is no motion to extrapolate.
    """
    count, snippets, unusable, repeated = len(drive), drive.snippets, drive.unusable, drive.repeated
    if not snippets:
        why = next(iter(unusable.values()), "the sequence is too short")
        raise SlamError(f"no {sources + 1} usable frames in a row among {count}: {why}")
    new = set(range(count)).difference(unusable, repeated)
    raw = network_steps(snippets)
    calibration = calibrate_network(raw, _poses(drive.steps), np.ones(count))
    by_network = calibration.scaled(raw)
    frozen, steps = _without_frozen(by_network, drive.steps, map_poses, repeated, new)
    frames = dict(unusable) | dict.fromkeys(frozen, "the image stands still while the camera moves")
    spans = ((s, {s.target, *s.sources}) for s in snippets)
    trusted = [
        s
        for s, span in spans
        if not frozen & span and not any(min(span) < cut <= max(span) for cut in cuts)
    ]
    filled = _filled(snippets, _completed(raw, range(count - 1)), count, sources)
    by_image = {
        m.ends[0]: m.relative_pose.T_from_to
        for m in steps.values()
        if m.ends == (m.ends[0], m.ends[0] + 1)
    }
    # snippets of frozen images alone are still the best estimate available
    known = calibration.scaled(network_steps(trusted)) | by_image or by_network
    covered = {
        step for s in trusted for step in range(min(s.sources), max(s.sources))
    } | by_image.keys()
    loose = [step for step in range(count - 1) if step not in covered]
    motion = _completed(known, loose)
    for pose in _poses(steps):  # over gaps
        over = range(*pose.ends)
        if len(over) > 1 and set(loose).issuperset(over):
            motion |= dict.fromkeys(over, equal_step(pose.T_from_to, len(over)))
    typical = float(np.median([np.linalg.norm(T[:3, 3]) for T in known.values()]))
    gap_steps = []
    for step in loose:
        length = max(float(np.linalg.norm(motion[step][:3, 3])), typical, _SIGMA_FLOOR)
        sigmas = np.repeat(
            [np.deg2rad(_ROTATION_SIGMA_DEG), _TRANSLATION_RELATIVE_SIGMA * length], 3
        )
        gap_steps.append(RelativePose(step, step + 1, motion[step], sigmas, INTERPOLATED_SOURCE))
    return replace(
        drive,
        snippets=filled,
        trusted=trusted,
        motions=list(steps.values()),
        interpolated=dict(sorted(frames.items())),
        gap_steps=gap_steps,
        views=[view for view in drive.views if view.index not in frames],
        keyframes=[keyframe for keyframe in drive.keyframes if keyframe.index not in frames],
    )


def _without_frozen(
    by_network: Mapping[int, FloatArray],
    steps: Steps,
    map_poses: KeyframePoses,
    repeated: Collection[int],
    new: Collection[int],
) -> tuple[set[int], Steps]:
    """Repeated frames during which the camera moved, and the steps that remain without them.

    The length of the step to the next new image decides: short if the camera stood; the length of as many steps as
    images were repeated if it moved. A length between the two is a failed match over a wide baseline and is not used.
    Without a new image soon after the camera is assumed to stand.
    """
    frozen: set[int] = set()
    for first, last in runs(repeated):
        before = [
            T for k, T in by_network.items() if first - 1 - _STEPS_OF_A_MOTION <= k < first - 1
        ]
        following = next((k for k in range(last + 1, last + 2 + _LONGEST_DOUBT) if k in new), None)
        if not before or following is None:
            continue
        expected = float(np.median([np.linalg.norm(T[:3, 3]) for T in before]))
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
        around = (
            slice(max(after - _STEPS_OF_A_MOTION, 0), after),
            slice(after, after + _STEPS_OF_A_MOTION),
        )
        ends = [(numbers[part], motion[part].mean(axis=0)) for part in around if len(numbers[part])]
        distances = np.array([np.abs(near - step).min() for near, _ in ends], np.float64)[::-1]
        found[row] = distances @ np.array([mean for _, mean in ends]) / distances.sum()
    T = from_rotation_vector(found[:, :3], found[:, 3:])
    return {**known, **dict(zip(unknown, T, strict=True))}


def _filled(
    snippets: Sequence[SnippetPoses], steps: Mapping[int, FloatArray], count: int, sources: int
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


def smooth_rotations(steps: Steps, relative_rotations: Sequence[RelativeRotation]) -> Steps:
    """The steps with rotations fitted robustly to single steps and relative rotations, directions corrected alike.

    Least squares over one small rotation for each triangulated step, in its current camera. The residual of a
    relative rotation is the sum of the corrections of its steps, each in its last camera. Rotations over a step that is
    not triangulated are not used.
    """
    motions = triangulated(steps)
    by_start = shortest_by_start(motions)
    paths = [(rotation, path_between(by_start, *rotation.ends)) for rotation in relative_rotations]
    usable = [(rotation, path) for rotation, path in paths if path]
    if not usable:
        return steps
    T_current_previous = invert(
        np.array([motion.relative_pose.T_from_to for motion in motions.values()])
    )
    R_current_previous = dict(zip(motions, T_current_previous[:, :3, :3], strict=True))
    A, target = _equations(R_current_previous, usable)
    # relative rotations that overlap share their images: overlapping ones count as one
    overlapping = max(len(path) for _, path in usable)
    sigmas = np.concatenate([motion.relative_pose.sigmas[:3] for motion in motions.values()])
    own = 1.0 / (_STEP_WIDENING * sigmas) ** 2
    prior = coo_array((own, (np.arange(len(own)),) * 2)).tocsr()
    correction = np.zeros(len(own))
    for _ in range(_ITERATIONS):
        residual = np.linalg.norm((A @ correction - target).reshape(-1, 3), axis=1)
        weights = np.repeat(1.0 / (1.0 + (residual / _OUTLIER_SIGMAS) ** 2), 3) / overlapping
        weighted = A.multiply(weights[:, None]).T.tocsr()
        correction = np.atleast_1d(spsolve((weighted @ A + prior).tocsc(), weighted @ target))
    turns = correction.reshape(-1, 3)
    T_current_previous[:, :3, :3] = (
        Rotation.from_rotvec(turns).as_matrix() @ T_current_previous[:, :3, :3]
    )
    covariances = np.array([motion.covariance for motion in motions.values()])
    moves = covariances[:, 3:, :3] @ np.linalg.solve(covariances[:, :3, :3], turns[:, :, None])
    directions = T_current_previous[:, :3, 3]
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    turned = directions + lengths * moves[:, :, 0]
    T_current_previous[:, :3, 3] = turned * lengths / np.linalg.norm(turned, axis=1, keepdims=True)
    smoothed = {
        ends: replace(motion, relative_pose=replace(motion.relative_pose, T_from_to=T))
        for (ends, motion), T in zip(motions.items(), invert(T_current_previous), strict=True)
    }
    return {**steps, **smoothed}


def _equations(
    R_current_previous: Mapping[Ends, FloatArray],
    usable: Sequence[tuple[RelativeRotation, list[Ends]]],
) -> tuple[csr_array, FloatArray]:
    """Whitened equations of all relative rotations in the corrections of steps: matrix and right side."""
    place = {ends: 3 * n for n, ends in enumerate(R_current_previous)}
    rows, columns, entries, R_residual = [], [], [], []
    for n, (rotation, path) in enumerate(usable):
        R_last_step = np.eye(3)
        for ends in reversed(path):
            rows.append(3 * n + _BLOCK // 3)
            columns.append(place[ends] + _BLOCK % 3)
            entries.append((R_last_step / rotation.sigmas[:, None]).ravel())
            R_last_step = R_last_step @ R_current_previous[ends]
        R_residual.append(rotation.R_to_from @ R_last_step.T)
    sigmas = np.array([rotation.sigmas for rotation, _ in usable])
    target = Rotation.from_matrix(np.array(R_residual)).as_rotvec() / sigmas
    shape = 3 * len(usable), 3 * len(place)
    A = coo_array(
        (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))), shape=shape
    )
    return A.tocsr(), target.ravel()
