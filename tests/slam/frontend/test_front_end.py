import pickle
from collections.abc import Sequence

import numpy as np
import pytest
import room
from oracle import OraclePredictor

from slam import Slam
from slam.config.sections import (
    KeyframesConfig,
    LoopsConfig,
    MappingConfig,
    SlamConfig,
    VisualOdometryConfig,
)
from slam.frames import DepthMap, Frame, RelativePose
from slam.frontend.drive import Drive
from slam.frontend.front_end import MotionTracker, choose
from slam.frontend.gaps import complete_drive
from slam.frontend.keyframes.relative_poses import keyframe_poses
from slam.frontend.measured import FrontEnd, Measured
from slam.frontend.visual.motion import Motion
from slam.geometry.se3 import FloatArray, chain, from_rotation_vector
from slam.pipeline.observer import Observer
from slam.runtime.stopwatch import Stopwatch

KEYFRAMES_ALONE = SlamConfig(
    keyframes=KeyframesConfig(use="always"),
    loops=LoopsConfig(enabled=False),
    mapping=MappingConfig(enabled=False),
)
KEYFRAMES_WITH_LOOPS = SlamConfig(
    keyframes=KeyframesConfig(use="always"), visual_odometry=VisualOdometryConfig(enabled=False)
)


def steps(count: int, scatter: float, seconds: float = 0.1) -> Measured:
    """Steps of a camera height each."""
    rng = np.random.default_rng(0)
    motions = {}
    for k in range(count):
        T = from_rotation_vector(
            np.zeros(3), np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, scatter, 3)
        )
        pose = RelativePose(k, k + 1, T, np.ones(6), "essential")
        motions[pose.ends] = Motion(pose, np.eye(6), seconds=seconds)
    return Measured(steps=motions, roads=[1.0] * count)


@pytest.mark.parametrize(
    ("count", "scatter", "seconds", "front_end"),
    [
        (60, 0.02, 0.1, FrontEnd.STEPS),
        (60, 1.0, 0.1, FrontEnd.KEYFRAMES),
        (60, 0.02, 1.0, FrontEnd.KEYFRAMES),
        (12, 0.02, 0.1, FrontEnd.STEPS),
        (12, 1.0, 0.1, FrontEnd.KEYFRAMES),
        (12, 0.02, 1.0, None),
        (8, 0.02, 0.1, None),
    ],
)
def test_a_vehicle_goes_the_same_way_for_a_while_and_fast(
    count: int, scatter: float, seconds: float, front_end: FrontEnd | None
):
    drive = steps(count, scatter, seconds)
    assert choose(KeyframesConfig(), None, drive) is front_end
    drive.roads[:] = [None if k % 4 else 1.0 for k in range(count)]
    assert choose(KeyframesConfig(), None, drive) is not FrontEnd.STEPS


def test_a_known_camera_height_and_a_setting_choose():
    by_hand = steps(60, 1.0)
    assert choose(KeyframesConfig(), 1.65, by_hand) is FrontEnd.STEPS
    assert choose(KeyframesConfig(use="never"), None, by_hand) is FrontEnd.STEPS
    assert choose(KeyframesConfig(use="always"), 1.65, by_hand) is FrontEnd.KEYFRAMES


def completed(observer: Observer) -> Drive:
    measured = observer.finish()
    return complete_drive(measured, 4, keyframe_poses(measured.maps, room.INTRINSICS))


@pytest.mark.parametrize("stands", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_steps_are_measured_where_keyframes_have_no_pose(stands: bool):
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
    late = [ends for ends in observer.measured.steps if ends[0] > 19]
    assert late == [(23, 26)]
    assert set(drive.interpolated) == {*blank, *(() if stands else repeated)}


@pytest.mark.parametrize(
    "interrupted",
    [(20, 22), *(pytest.param(frames, marks=pytest.mark.slow) for frames in ((), (19, 21)))],
)
def test_depth_is_predicted_for_keyframes_alone(interrupted: tuple[int, ...]):
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
                observer.finish()
        drive = completed(observer)
    keyframes = drive.measured.maps[-1].keyframes
    assert all(
        np.isfinite(keyframe.learned_depth).any()
        for keyframe in keyframes
        if keyframe.grey is not None
    )
    assert [k for k in predicted if k >= 20] == [
        keyframe.index for keyframe in keyframes if keyframe.index >= 20
    ]
    snippets = [*drive.measured.snippets]
    assert [sources[0] for sources in snippets if sources[0] > 16] == [20, 24, 28, 32]
    assert len(snippets[0]) == 4 and not drive.interpolated


def test_observations_stay_while_frames_follow():
    truth = room.walk(40)
    oracle = OraclePredictor(truth, lambda k: room.depth_map(truth[k]))
    with Observer(oracle, room.INTRINSICS, KEYFRAMES_ALONE, Stopwatch()) as observer:
        for k in range(26):
            observer.add(k, room.frame(k, truth[k]))
        drive = observer.finish()
        before = pickle.dumps(drive)
        for k in range(26, 40):
            observer.add(k, room.frame(k, truth[k]))
        assert len(observer.finish()) == 40
    assert drive.maps and drive.events and pickle.dumps(drive) == before


def test_what_keyframes_measured_stays_when_the_camera_is_lost():
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


def tracked(truth: FloatArray, unseen: Sequence[int], sparse: Sequence[int] = ()) -> Measured:
    """After some frames, of which some show another scene, and some have no depth."""
    tracker = MotionTracker(
        KEYFRAMES_WITH_LOOPS,
        room.INTRINSICS,
        Measured(),
        Stopwatch(),
        seen=lambda frame: pytest.fail("steps are not measured"),
        on_keyframe=lambda frame: None,
    )
    for k, T in enumerate(truth):
        frame = room.frame(k, T, 9 if k in unseen else 0)
        tracker.add([], frame)
        if k not in sparse:
            tracker.learn(frame, room.depth_map(T))
    return tracker.finish()


def test_after_a_short_loss_the_camera_is_found_again_in_its_map():
    walked = room.there_and_back(110, roll=0.4, closer=0.3)
    truth = np.concatenate([walked[:60], walked[82:]])
    measured = tracked(truth, range(60, 66))
    _, lost, found = measured.events
    assert (lost.event, lost.frame) == ("lost", 60)
    assert (found.event, found.frame) == ("relocalised", 66)
    assert found.other is not None
    assert found.other < 40
    poses = keyframe_poses(measured.maps, room.INTRINSICS)
    assert set(poses.segments) == {*range(60), *range(66, 88)}
    position, rotation = room.errors(poses, truth)
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
):
    truth = room.there_and_back(110, roll=0.4, closer=0.3)[places]
    events = tracked(truth, unseen, sparse).events
    assert [each.frame for each in events if each.event == "relocalised"] == relocalised
