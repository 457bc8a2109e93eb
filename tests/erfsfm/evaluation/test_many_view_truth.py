"""Depth errors without true depth, on a simulated drive whose poses are given."""

import numpy as np
import pytest

from erfsfm.common.errors import DataError
from erfsfm.data.discovery import discover
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.evaluation.many_view_truth import TRUTH_FOLDER, many_view_protocol
from erfsfm.evaluation.streets import EVERY
from slam.simulation.kitti_layout import write_kitti_root
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

HEIGHT_M = 1.65


class Networks:
    """True depth in another scale, or the same depth everywhere."""

    sources = 4

    def __init__(self, recording, right):
        self._images = [recording.image(i, 128, 416).tobytes() for i in range(len(recording))]
        self._recording, self._right = recording, right
        self.seen = []

    def depth(self, image):
        if not self._right:
            return np.ones(image.shape[:2], np.float32)
        true = self._recording.true_depth(self._images.index(image.tobytes()))
        return np.where(true > 0, true, 1e3).astype(np.float32) / 7

    def poses(self, images):
        raise AssertionError("not asked for")

    def leaks(self, names):
        return self.seen


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    root = tmp_path_factory.mktemp("world") / "world"
    street = SimulatedStreet(SimulationOptions(frames=13, seed=707, route="straight", width=416, height=128))
    write_kitti_root(street, root, depth=True)
    return root


@pytest.fixture(scope="module")
def cache(world, tmp_path_factory):
    """The drive's poses as a run would leave them, so that none is needed."""
    folder, recording = tmp_path_factory.mktemp("cache"), discover(world)[0]
    T_world_camera = recording.true_poses().copy()
    T_world_camera[:, :3, 3] /= HEIGHT_M
    ManyViewTeacher(folder / TRUTH_FOLDER, (128, 416), EVERY).drive(recording).keep_poses(T_world_camera)
    return folder


def rows_of(networks, world, cache, sequences=(), allow_leak=False):
    return many_view_protocol(networks, world, sequences, cache, allow_leak, lambda *_: None)


def test_true_depth_is_right_and_constant_depth_is_wrong(world, cache):
    recording = discover(world)[0]
    (right,) = rows_of(Networks(recording, right=True), world, cache)
    (wrong,) = rows_of(Networks(recording, right=False), world, cache)
    assert right["images"] == wrong["images"] == 2, "every fifth frame that has two neighbours on either side"
    assert right["abs_rel"] < 0.08 < 0.2 < wrong["abs_rel"]
    assert 0.3 < right["known"] == wrong["known"] < 1
    assert right["recording"] == "simulated/707[0:13]" and right["leak"] is False


def test_leaks_and_recordings_that_are_not_there_are_refused(world, cache):
    networks = Networks(discover(world)[0], right=False)
    with pytest.raises(DataError, match="no sequence 7"):
        rows_of(networks, world, cache, ["7"])
    networks.seen = ["simulated/707"]
    with pytest.raises(DataError, match="leak"):
        rows_of(networks, world, cache)
    (row,) = rows_of(networks, world, cache, allow_leak=True)
    assert row["leak"] is True
