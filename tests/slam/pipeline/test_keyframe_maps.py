import functools
import pickle
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import room
from oracle import OraclePredictor

from erfsfm.common.processes import opencv_threads
from slam import Slam
from slam.config.sections import KeyframesConfig, LoopsConfig, MappingConfig, SlamConfig
from slam.frames import LOOP_SOURCE, DepthMap, Frame, RelativePose, View
from slam.frontend.completion import complete_drive
from slam.frontend.drive import Drive
from slam.frontend.keyframes.odometry import KeyframeOdometry
from slam.frontend.keyframes.relative_poses import KeyframePoses, chained, keyframe_poses
from slam.frontend.visual.motion import Motion
from slam.geometry.se3 import (
    FloatArray,
    chain,
    from_rotation_vector,
    invert,
    rotation_angle,
    umeyama,
)
from slam.loops.closure import LoopClosures, Track, find_loops
from slam.loops.verification import Loop
from slam.pipeline import keyframe_maps
from slam.pipeline.keyframe_maps import FrontEnd, KeyframeTracking, MapClosure, choose, close_maps
from slam.pipeline.observer import Observer
from slam.runtime.errors import Failed
from slam.runtime.resources import Stopwatch
from slam.sequences.catalogue import open_sequence


def steps(count: int, scatter: float, seconds: float = 0.1) -> Drive:
    """Steps of a camera height each."""
    rng = np.random.default_rng(0)
    motions = []
    for k in range(count):
        T = from_rotation_vector(
            np.zeros(3), np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, scatter, 3)
        )
        pose = RelativePose(k, k + 1, T, np.ones(6), "essential")
        motions.append(Motion(pose, np.eye(6), seconds=seconds))
    return Drive(motions=motions, roads=[1.0] * count)


@pytest.mark.parametrize(
    ("count", "scatter", "seconds", "front_end"),
    [
        *((60, 0.02, 0.1, "steps"), (60, 1.0, 0.1, "keyframes"), (60, 0.02, 1.0, "keyframes")),
        *(
            (12, 0.02, 0.1, "steps"),
            (12, 1.0, 0.1, "keyframes"),
            (12, 0.02, 1.0, "both"),
            (8, 0.02, 0.1, "both"),
        ),
    ],
)
def test_a_vehicle_goes_the_same_way_for_a_while_and_fast(
    count: int, scatter: float, seconds: float, front_end: FrontEnd
) -> None:
    drive = steps(count, scatter, seconds)
    assert choose(KeyframesConfig(), None, drive) == front_end
    drive.roads[:] = [Failed("no road")] * count
    assert choose(KeyframesConfig(), None, drive) != "steps"


def test_a_known_camera_height_and_a_setting_choose() -> None:
    by_hand = steps(60, 1.0)
    assert choose(KeyframesConfig(), 1.65, by_hand) == "steps"
    assert choose(KeyframesConfig(use="never"), None, by_hand) == "steps"
    assert choose(KeyframesConfig(use="always"), 1.65, by_hand) == "keyframes"


KEYFRAMES_ALONE = SlamConfig(
    keyframes=KeyframesConfig(use="always"),
    loops=LoopsConfig(enabled=False),
    mapping=MappingConfig(enabled=False),
)


def completed(observer: Observer) -> Drive:
    drive = observer.measured()
    return complete_drive(drive, 4, keyframe_poses(drive.maps, room.INTRINSICS))


@pytest.mark.parametrize("stands", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_steps_are_measured_where_keyframes_have_no_pose(stands: bool) -> None:
    """Before their map begins and over a gap, not beside repeated images: the map tells whether the camera stood."""
    truth, blank, repeated = room.walk(40), (24, 25), (32, 33)
    if stands:
        truth[34:] = truth[32:38]
    truth[[*repeated]] = truth[31]
    oracle = OraclePredictor(
        truth, lambda k: 0.5 * room.depth_map(truth[k])
    )  # in the unit of its poses
    with Observer(oracle, room.INTRINSICS, KEYFRAMES_ALONE, Stopwatch()) as observer:
        for k, T in enumerate(truth):
            frame = room.frame(k, T)
            observer.add(
                k, Frame(k, frame.stamp, np.zeros_like(frame.image)) if k in blank else frame
            )
        drive = completed(observer)
    started = min(drive.map_poses.segments)
    assert started < 10 and len(drive.map_poses.segments) == 40 - len(blank) - started
    late = [motion.ends for motion in observer.drive.motions if motion.ends[0] > 19]
    assert late == [(23, 26)]
    assert set(drive.interpolated) == {*blank, *(() if stands else repeated)}


@pytest.mark.parametrize(
    "interrupted",
    [(20, 22), *(pytest.param(frames, marks=pytest.mark.slow) for frames in ((), (19, 21)))],
)
def test_depth_is_predicted_for_keyframes_alone(interrupted: tuple[int, ...]) -> None:
    """The same ones where the observations are asked for in between."""
    truth = room.walk(40)
    predicted: list[int] = []

    def depth(k: int) -> DepthMap:
        predicted.append(k)
        return room.depth_map(truth[k])

    oracle = OraclePredictor(truth, depth)
    with Observer(oracle, room.INTRINSICS, KEYFRAMES_ALONE, Stopwatch()) as observer:
        for k, T in enumerate(truth):
            observer.add(k, room.frame(k, T))
            if k in interrupted:
                observer.measured()
        drive = completed(observer)
    keyframes = drive.maps[-1].keyframes
    assert all(
        np.isfinite(keyframe.learned_depth).any()
        for keyframe in keyframes
        if keyframe.grey is not None
    )
    assert [k for k in predicted if k >= 20] == [
        keyframe.index for keyframe in keyframes if keyframe.index >= 20
    ]
    assert [snippet.target for snippet in drive.trusted if snippet.target > 18] == [22, 26, 30, 34]
    assert len(drive.trusted[0].sources) == 4 and not drive.interpolated


@pytest.mark.parametrize("camera_height_m", [None, 1.65])
def test_opencv_takes_all_cores_for_keyframes_alone(
    camera_height_m: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A known height is that of a vehicle, whose networks need a core of their own."""
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    truth = room.walk(2)
    oracle, config = OraclePredictor(truth, lambda k: room.depth_map(truth[k])), SlamConfig()
    with opencv_threads(1):
        with Observer(
            oracle, room.INTRINSICS, config, Stopwatch(), camera_height_m=camera_height_m
        ):
            assert cv2.getNumThreads() == (3 if camera_height_m is None else 1)
        assert cv2.getNumThreads() == 1


def test_observations_stay_while_frames_follow() -> None:
    truth = room.walk(40)
    oracle = OraclePredictor(truth, lambda k: room.depth_map(truth[k]))
    with Observer(oracle, room.INTRINSICS, KEYFRAMES_ALONE, Stopwatch()) as observer:
        for k in range(26):
            observer.add(k, room.frame(k, truth[k]))
        drive = observer.measured()
        before = pickle.dumps(drive)
        for k in range(26, 40):
            observer.add(k, room.frame(k, truth[k]))
        assert len(observer.measured()) == 40
    assert drive.maps and drive.events and pickle.dumps(drive) == before


def test_what_keyframes_measured_stays_when_the_camera_is_lost() -> None:
    """Although the networks see another motion."""
    truth, blank = room.walk(40), range(27, 40)
    straight = chain(from_rotation_vector(np.zeros((39, 3)), np.tile([0.0, 0.0, 0.1], (39, 1))))
    oracle = OraclePredictor(straight, lambda k: room.depth_map(truth[k]))
    with Slam(oracle, room.INTRINSICS, KEYFRAMES_ALONE) as slam:
        for k, T in enumerate(truth):
            image = room.frame(k, T).image
            slam.add_frame(np.zeros_like(image) if k in blank else image, 0.1 * k)
            if k == blank[0] - 1:
                before = slam.trajectory().T_world_camera
        after = slam.trajectory().T_world_camera
    np.testing.assert_array_equal(after[: len(before)], before)
    assert np.linalg.norm(after[-1, :3, 3] - before[-1, :3, 3]) > 0.0


CONFIG = SlamConfig()


def there_and_back(frames: int, roll: float = 0.0, closer: float = 0.0) -> FloatArray:
    """Down along both walls, turning away from the start, and back to it, rolled and closer."""
    phase = np.linspace(0.0, 1.0, frames)
    away = np.sin(np.pi * phase)
    centres = np.column_stack([0.2 * np.sin(4 * np.pi * phase), 1.3 * away, closer * phase])
    turns = np.column_stack([-0.35 * away, 0.02 * np.sin(9.0 * phase), roll * phase])
    return from_rotation_vector(turns, centres)


@functools.cache
def lost_on_the_way() -> tuple[FloatArray, KeyframeOdometry]:
    """Two maps, and the true poses; on the way back the camera is rolled and closer."""
    walked = there_and_back(80, roll=0.4, closer=0.3)
    truth = np.concatenate([walked[:22], walked[35:]])
    return truth, room.tracked(truth, [0] * 22 + [9] * 7 + [0] * 38)


def closed(state: KeyframeOdometry) -> MapClosure:
    maps = [segment for segment in state.segments if segment.started]
    return close_maps(maps, keyframe_poses(maps, room.INTRINSICS), room.INTRINSICS)


def errors(found: KeyframePoses, truth: FloatArray) -> tuple[float, float]:
    """Of the last map: root mean square of aligned positions, largest of rotations since its first frame in degrees."""
    last = max(found.segments.values())
    poses = [pose for pose in found.poses if found.segments[pose.to_index] == last]
    T = chained(poses)
    frames = sorted(T)
    estimate, true = np.stack([T[k] for k in frames]), truth[frames]
    similarity = umeyama(true[:, :3, 3], estimate[:, :3, 3], with_scale=True)
    aligned = similarity.apply_to_poses(estimate)
    distance = np.linalg.norm(aligned[:, :3, 3] - true[:, :3, 3], axis=1)
    since_first = true[0, :3, :3].T @ true[:, :3, :3]
    turned = rotation_angle(np.swapaxes(estimate[:, :3, :3], 1, 2) @ since_first)
    return float(np.sqrt((distance**2).mean())), float(np.rad2deg(turned).max())


@pytest.mark.slow
def test_maps_before_and_after_a_loss_are_joined_where_the_camera_is_rolled_and_closer() -> None:
    truth, state = lost_on_the_way()
    assert sum(segment.started for segment in state.segments) == 2
    assert [event.event for event in state.events] == ["map begun", "lost", "map begun"]
    after = closed(state)
    assert len(set(after.poses.segments.values())) == 1
    (join,) = after.joins
    assert join.event == "map joined"
    assert join.other is not None
    assert join.other < 22 < 29 <= join.frame
    position, rotation = errors(after.poses, truth)
    assert position < 0.01
    assert rotation < 0.3
    for pose, loop in zip(after.poses.loops, after.loops.accepted, strict=True):
        T = invert(truth[pose.from_index]) @ truth[pose.to_index]
        assert np.rad2deg(rotation_angle(T[:3, :3].T @ loop.measured.T_from_to[:3, :3])) < 3.0


@pytest.mark.filterwarnings(
    "ignore:Mean of empty slice", "ignore:invalid value"
)  # it has no corners
@pytest.mark.slow
def test_maps_are_joined_where_a_loop_within_one_of_them_has_more_inliers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The loop within the first map is added by hand, for in this small room the window finds such places itself."""

    def find(views: Sequence[View], track: Track, *rest: Any) -> LoopClosures:
        closures = find_loops(views, track, *rest)
        last = int(np.flatnonzero(track.maps == 0)[-1])
        T = invert(track.T_world_camera[0]) @ track.T_world_camera[last]
        within = RelativePose(
            int(track.frames[0]), int(track.frames[last]), T, np.full(6, 0.01), LOOP_SOURCE
        )
        loop = Loop(within, 1 + max(loop.inliers for loop in closures.accepted), 1.0)
        return replace(closures, accepted=(*closures.accepted, loop))

    monkeypatch.setattr(keyframe_maps, "find_loops", find)
    back, closer = there_and_back(90, roll=0.02), there_and_back(110, roll=0.5, closer=0.3)
    truth = np.concatenate([back, back[:6], closer[95:]])
    after = closed(room.tracked(truth, [0] * 90 + [9] * 6 + [0] * 15))
    assert [event.event for event in after.joins] == ["map joined"]
    assert errors(after.poses, truth)[0] < 0.01


def tracked(
    truth: FloatArray, unseen: Sequence[int], sparse: Sequence[int] = ()
) -> KeyframeTracking:
    """After some frames, of which some show another scene, and some have no depth."""
    tracking = KeyframeTracking(KeyframesConfig(use="always"), CONFIG.loops, room.INTRINSICS, 0)
    for k, T in enumerate(truth):
        frame = room.frame(k, T, 9 if k in unseen else 0)
        tracking.follow(frame)
        if k not in sparse:
            tracking.learn(frame, room.depth_map(T))
    return tracking


def test_after_a_short_loss_the_camera_is_found_again_in_its_map() -> None:
    walked = there_and_back(110, roll=0.4, closer=0.3)
    truth = np.concatenate([walked[:60], walked[82:]])
    tracking = tracked(truth, range(60, 66))
    _, lost, found = tracking.events
    assert (lost.event, lost.frame) == ("lost", 60)
    assert (found.event, found.frame) == ("relocalised", 66)
    assert found.other is not None
    assert found.other < 40
    poses = keyframe_poses(tracking.maps(Drive()), room.INTRINSICS)
    assert set(poses.segments) == {*range(60), *range(66, 88)}
    position, rotation = errors(poses, truth)
    assert position < 0.01
    assert rotation < 0.3


@pytest.mark.parametrize(
    ("places", "unseen", "sparse", "relocalised"),
    [
        pytest.param(
            [*range(60), *range(82, 89), *range(35, 38)],
            range(60, 66),
            (),
            [66, 67],
            marks=pytest.mark.slow,
        ),
        pytest.param([*range(61), 68, 60, 8], (60, 62), (61,), [63], marks=pytest.mark.slow),
        pytest.param([*range(70), 40, 41], range(60, 70), (), [], marks=pytest.mark.slow),
    ],
    ids=[
        "relocalised before",
        "located in a frame without depth before",
        "in a map that has just begun",
    ],
)
def test_a_camera_that_is_lost_again_at_once_is_found_in_the_map_as_it_then_is(
    places: list[int], unseen: Sequence[int], sparse: Sequence[int], relocalised: list[int]
) -> None:
    truth = there_and_back(110, roll=0.4, closer=0.3)[places]
    events = tracked(truth, unseen, sparse).events
    assert [each.frame for each in events if each.event == "relocalised"] == relocalised


@pytest.mark.slow
def test_another_scene_is_no_loop() -> None:
    walked = there_and_back(110)
    after = closed(room.tracked(np.concatenate([walked[:45], walked[:45]]), [0] * 45 + [7] * 45))
    assert after.loops.accepted == ()
    assert after.joins == ()
    assert len(set(after.poses.segments.values())) == 2


@pytest.mark.data
@pytest.mark.slow
def test_a_real_hand_held_recording_and_its_loops(data_root: Path) -> None:
    """With flat learned depth: no network takes part."""
    recording = data_root / "handheld_kitchen"
    sequence = open_sequence(recording / "images")
    indices = range(0, 320, 4)
    truth = np.loadtxt(recording / "poses.kitti.txt").reshape(-1, 3, 4)
    odometry = KeyframeOdometry(sequence.intrinsics)
    flat = np.ones((sequence.intrinsics.height, sequence.intrinsics.width), np.float32)
    for k in indices:
        frame = replace(sequence.frame(k), index=k // 4)
        odometry.follow(frame)
        odometry.learn(frame, flat)
    maps = odometry.segments
    before = keyframe_poses(maps, sequence.intrinsics)
    after = close_maps(maps, before, sequence.intrinsics)
    T_world_camera = np.tile(np.eye(4), (len(truth), 1, 1))
    T_world_camera[:, :3] = truth
    assert sorted(before.segments) == list(range(80))
    T_world_camera = T_world_camera[indices]
    assert len(after.loops.accepted) >= 8
    for pose in after.poses.loops:
        T = invert(T_world_camera[pose.from_index]) @ T_world_camera[pose.to_index]
        assert np.rad2deg(rotation_angle(T[:3, :3].T @ pose.T_from_to[:3, :3])) < 5.0
    error = errors(before, T_world_camera)[0]
    assert error < 0.04
    assert errors(after.poses, T_world_camera)[0] < 0.95 * error
