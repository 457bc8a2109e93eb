"""The many-view teacher on a simulated drive: poses by the SLAM system, labels, what is kept."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from erfsfm.common.errors import TrainingError
from erfsfm.data.discovery import discover
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.data.recordings import Recording
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import write_kitti_root
from slam.simulation.street import SimulatedStreet

SIZE = (64, 208)


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Recording:
    root = tmp_path_factory.mktemp("world")
    write_kitti_root(
        SimulatedStreet(SimulationOptions("straight", 20, 704, 312, 96)), root / "world", depth=True
    )
    return discover(root / "world")[0]


@pytest.fixture(scope="module")
def teacher(recording, tmp_path_factory) -> ManyViewTeacher:
    """Its poses are the true ones."""
    teacher = ManyViewTeacher(tmp_path_factory.mktemp("teacher"), SIZE, stride=8)
    T_world_camera = recording.true_poses().copy()
    T_world_camera[:, :3, 3] /= 1.65
    teacher.drive(recording).keep_poses(T_world_camera)
    told = []
    teacher.prepare([recording], 4, "sim", lambda *progress: told.append(progress))
    assert told == [("teacher: depth", 2, 2)]
    return teacher


@pytest.mark.slow
def test_the_slam_system_gives_the_motion_in_camera_heights(recording, tmp_path):
    teacher, told = ManyViewTeacher(tmp_path, SIZE, stride=8), []
    teacher.prepare([recording], 4, "sim", lambda *progress: told.append(progress))
    assert told[0] == ("teacher: poses", 0, 1) and told[-1] == ("teacher: depth", 2, 2)
    true = recording.true_poses()
    estimate = teacher.drive(recording).T_world_camera
    assert estimate.shape == (20, 4, 4)
    length_m = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    length = np.linalg.norm(np.diff(estimate[:, :3, 3], axis=0), axis=1).sum()
    assert length_m / length == pytest.approx(1.65, rel=0.1)
    with pytest.raises(
        TrainingError,
        match=r"poses of simulated/704\[0:20\] by the weights 'sim', and .* 'default'",
    ):
        teacher.prepare([recording], 4, "default", lambda *_: None)


def test_a_snippet_has_its_motion_and_its_targets_bounds(recording, teacher):
    drive = teacher.drive(recording)
    assert list(drive.targets(4)) == [8, 16]
    seen = teacher.structure(recording, first=6, sources=4)
    assert seen.least.shape == seen.most.shape == SIZE
    true = recording.true_poses()
    expected = np.linalg.inv(true[[6, 7, 9, 10]]) @ true[8]
    got = seen.T_source_target.copy()
    got[:, :3, 3] *= 1.65
    np.testing.assert_allclose(got, expected, atol=0.25)
    narrow = (seen.least > 0) & (seen.most < 1.5 * seen.least)
    assert narrow.mean() > 0.3


def test_what_was_measured_is_kept_and_what_was_lost_is_measured_again(recording, teacher):
    drive = teacher.drive(recording)
    kept, lost = drive.label_file(16), drive.label_file(8)
    before, written = lost.read_bytes(), kept.stat().st_mtime_ns
    lost.unlink()
    told = []
    teacher.prepare([recording], 4, "sim", lambda *progress: told.append(progress))
    assert told == [("teacher: depth", 1, 1)]
    assert kept.stat().st_mtime_ns == written and len(lost.read_bytes()) == len(before)


def test_labels_are_made_again_when_an_image_changed(recording, tmp_path):
    shutil.copytree(recording.images[0].parents[3], tmp_path / "world")
    copy = discover(tmp_path / "world")[0]

    def folder():
        return ManyViewTeacher(tmp_path / "teacher", SIZE, stride=6).drive(copy).folder

    first = folder()
    assert folder() == first
    copy.images[3].write_bytes(copy.images[4].read_bytes())
    assert folder() != first


def test_an_image_that_cannot_be_read_has_no_label_and_is_no_neighbour(
    recording, teacher, tmp_path
):
    shutil.copytree(recording.images[0].parents[3], tmp_path / "world")
    broken = discover(tmp_path / "world")[0]
    broken.images[12].write_bytes(b"broken")
    drive = ManyViewTeacher(tmp_path / "teacher", SIZE, stride=6).drive(broken)
    drive.keep_poses(teacher.drive(recording).T_world_camera)
    drive.measure_labels([10, 12])
    least, most = drive.label(12)
    assert (least == 0).all() and np.isinf(most).all()
    assert (drive.label(10)[0] > 0).mean() > 0.3


def test_learned_depth_is_refined_around_a_frame_at_the_size_of_the_labels(
    recording, teacher, tmp_path
):
    asked = []

    def learned(image):
        asked.append(image.shape)
        rows = np.maximum(np.arange(SIZE[0], dtype=np.float32) - SIZE[0] * 0.45, 2)  # a level road
        return np.repeat(rows[:, None], SIZE[1], axis=1)

    drive = ManyViewTeacher(tmp_path, SIZE, stride=6).drive(recording)
    drive.keep_poses(teacher.drive(recording).T_world_camera)
    assert drive.measure_labels([12], learned) == 1 and asked == [(*SIZE, 3)]
    least, most = (bound.astype(np.float32) for bound in drive.label(12))
    narrow = (least > 0) & (most < 1.5 * least)
    true = cv2.resize(recording.true_depth(12), SIZE[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
    both = narrow & (true > 0)
    assert both.mean() > 0.3
    ratio = np.sqrt(least[both] * most[both]) * true[both] / 1.65
    assert (
        abs(np.median(ratio) - 1) < 0.1 and np.median(np.abs(ratio / np.median(ratio) - 1)) < 0.06
    )


@pytest.mark.slow
def test_a_drive_that_the_slam_system_cannot_follow_is_one_line(recording, tmp_path):
    short = recording.part(0, 3)
    with pytest.raises(
        TrainingError, match=r"poses of simulated/704\[0:3\] could not be found: .*3 frames"
    ):
        ManyViewTeacher(Path(tmp_path), SIZE, stride=1).prepare([short], 2, "sim", lambda *_: None)
