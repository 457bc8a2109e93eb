import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from erfsfm.common.readers.kitti import read_velodyne
from slam.frontend.lidar_odometry import LidarPath, has_scans, lidar_path, lidar_steps
from slam.runtime.errors import Failed
from slam.sequences.catalogue import open_sequence
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

FRAMES = 15


@dataclass
class Scanned:
    """The part of a sequence that LiDAR odometry uses."""

    T_camera_lidar: np.ndarray | None
    paths: dict[int, Path] = field(default_factory=dict)

    def __len__(self) -> int:
        return FRAMES

    def has_scan(self, index: int) -> bool:
        return index in self.paths

    def scan(self, index: int) -> np.ndarray:
        return read_velodyne(self.paths[index])


@pytest.fixture(scope="module")
def street() -> SimulatedStreet:
    return SimulatedStreet(SimulationOptions(route="straight", frames=FRAMES, seed=701))


def test_the_path_of_simulated_scans_is_the_camera_s(street, tmp_path):
    sequence = Scanned(street.T_camera_lidar)
    for k in range(0, FRAMES):
        sequence.paths[k] = tmp_path / f"{k:06d}.bin"
        street.scan(k).tofile(sequence.paths[k])
    path = lidar_path(sequence)
    np.testing.assert_array_equal(path.frames, np.arange(FRAMES))
    np.testing.assert_allclose(path.T_world_camera[0], np.eye(4), atol=1e-12)
    travelled = np.linalg.norm(street.T_world_camera[-1, :3, 3])
    error = np.linalg.norm(path.T_world_camera[-1, :3, 3] - street.T_world_camera[-1, :3, 3])
    assert error < 0.03 * travelled


def test_steps_are_those_between_neighbouring_scanned_frames():
    T_world_camera = np.tile(np.eye(4), (4, 1, 1))
    T_world_camera[:, 2, 3] = [0.0, 1.0, 4.0, 5.5]
    steps = lidar_steps(LidarPath(np.array([3, 4, 7, 8]), T_world_camera))
    assert [(s.from_index, s.to_index, s.source) for s in steps] == [
        (3, 4, "lidar"),
        (7, 8, "lidar"),
    ]
    assert [s.T_from_to[2, 3] for s in steps] == [1.0, 1.5]
    np.testing.assert_array_equal(steps[0].sigmas[3:], 0.03)


def test_scans_are_used_where_neighbours_have_them_and_the_extrinsics_are_known():
    files = {k: Path(f"{k}.bin") for k in (2, 3)}
    assert has_scans(Scanned(np.eye(4), files))
    assert not has_scans(Scanned(None, files))
    assert not has_scans(Scanned(np.eye(4), {2: Path("2.bin"), 5: Path("5.bin")}))
    assert not has_scans(Scanned(np.eye(4)))


def test_scans_that_cannot_be_read_are_left_out_with_one_warning(street, tmp_path, caplog):
    sequence = Scanned(street.T_camera_lidar, {k: tmp_path / f"{k}.bin" for k in range(4)})
    for k, path in sequence.paths.items():
        street.scan(k).tofile(path)
    sequence.paths[1].write_bytes(b"12345")
    path = lidar_path(sequence)
    assert isinstance(path, LidarPath)
    np.testing.assert_array_equal(path.frames, [0, 2, 3])
    assert "1.bin is no Velodyne scan" in path.unreadable[1] and list(path.unreadable) == [1]
    assert caplog.messages == [
        f"1 of 4 LiDAR scans cannot be read, first {path.unreadable[1]}: they are left out"
    ]
    assert path.T_world_camera[-1, 2, 3] == pytest.approx(street.T_world_camera[3, 2, 3], abs=0.5)


def test_without_two_scans_that_can_be_read_the_reason_stands_for_the_path(street, tmp_path):
    sequence = Scanned(street.T_camera_lidar, {k: tmp_path / f"{k}.bin" for k in range(2)})
    for path in sequence.paths.values():
        path.write_bytes(b"12345")
    failure = lidar_path(sequence)
    assert isinstance(failure, Failed)
    assert re.search(
        r"2 of 2 LiDAR scans .*0\.bin is no Velodyne scan.*; got [45] bytes", failure.reason
    )


@pytest.mark.slow
@pytest.mark.data
def test_drive_0013_is_as_long_as_its_oxts_path(data_root):
    sequence = open_sequence(data_root / "kitti_raw", frames="0:25")
    path = lidar_path(sequence)
    assert path is not None and sequence.reference is not None
    lengths = [
        np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1).sum()
        for T in (path.T_world_camera, sequence.reference[path.frames])
    ]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.01)
