"""nuScenes: the front camera by the data set's own tables, with true poses and LiDAR."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.runtime.errors import MissingFrameError, SequenceError
from slam.sequences.catalogue import open_sequence, sequence_kinds

HALF = 0.5  # the quaternion wxyz (0.5, -0.5, 0.5, -0.5) turns a car's axes to a camera's that looks ahead
AHEAD = [HALF, -HALF, HALF, -HALF]
FRAMES = 5


@pytest.fixture
def nuscenes(tmp_path: Path, images) -> Path:
    """Two scenes; the car goes 1 m along x each 80 ms. The rows are not in the order of time."""
    root = tmp_path / "nuscenes"
    images(root / "samples/CAM_FRONT", [f"{k}.jpg" for k in range(FRAMES)])
    (root / "samples/LIDAR_TOP").mkdir(parents=True)
    np.array([[1, 2, 3, 4, 5], [6, 7, 8, 9, 0]], np.float32).tofile(root / "samples/LIDAR_TOP/2.pcd.bin")
    mounts = {"cam": ([1.7, 0, 1.5], AHEAD), "lidar": ([0.9, 0, 1.8], [1, 0, 0, 0])}
    data: list[dict[str, Any]] = []
    for k in (3, 0, 1, 4, 2):
        row = {
            "sample_token": "s0",
            "ego_pose_token": f"e{k}",
            "calibrated_sensor_token": "cam",
            "width": 40,
            "height": 24,
        }
        data.append({**row, "timestamp": 10**15 + 80_000 * k, "filename": f"samples/CAM_FRONT/{k}.jpg"})
    row = {"sample_token": "s0", "ego_pose_token": "e2", "calibrated_sensor_token": "lidar", "width": 0, "height": 0}
    data.append({**row, "timestamp": 10**15 + 170_000, "filename": "samples/LIDAR_TOP/2.pcd.bin"})
    tables = {
        "scene": [{"token": "a", "name": "scene-0061"}, {"token": "b", "name": "scene-0103"}],
        "sample": [{"token": "s0", "scene_token": "a"}, {"token": "s1", "scene_token": "b"}],
        "sensor": [{"token": "c", "channel": "CAM_FRONT"}, {"token": "l", "channel": "LIDAR_TOP"}],
        "calibrated_sensor": [
            {"token": name, "sensor_token": name[0], "translation": t, "rotation": q, "camera_intrinsic": K}
            for (name, (t, q)), K in zip(mounts.items(), ([[30, 0, 20], [0, 30, 12], [0, 0, 1]], []), strict=True)
        ],
        "ego_pose": [{"token": f"e{k}", "translation": [k, 5, 0], "rotation": [1, 0, 0, 0]} for k in range(FRAMES)],
        "sample_data": data,
    }
    (root / "v1.0-mini").mkdir()
    for name, rows in tables.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return root


def test_nuscenes(nuscenes: Path) -> None:
    assert sequence_kinds(nuscenes) == {"scene-0061": "nuScenes", "scene-0103": "nuScenes"}
    sequence = open_sequence(nuscenes, "scene-0061")
    assert (len(sequence), sequence.intrinsics.fx, sequence.camera_height_m) == (FRAMES, 30, 1.5)
    assert sequence.stamps == pytest.approx(1e9 + 0.08 * np.arange(FRAMES))
    assert sequence.frame(3).image[0, 0, 0] == pytest.approx(30, abs=2)
    assert sequence.reference is not None
    assert sequence.reference[:, :3, 3] == pytest.approx(np.outer(np.arange(FRAMES), [0, 0, 1]), abs=1e-12)
    assert [k for k in range(FRAMES) if sequence.has_scan(k)] == [2]
    assert sequence.scan(2).tolist() == [[1, 2, 3], [6, 7, 8]]
    # the LiDAR is 0.8 m behind the camera and 0.3 m above it
    assert sequence.T_camera_lidar is not None
    assert sequence.T_camera_lidar[:3, 3] == pytest.approx([0, -0.3, -0.8])
    (nuscenes / "samples/CAM_FRONT/3.jpg").unlink()
    with pytest.raises(MissingFrameError, match=r"no image 3\.jpg"):
        open_sequence(nuscenes, "scene-0061").frame(3)


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("scene", "{", "cannot read table .*scene.json"),
        ("scene", "{}", r"scene\.json is no table of nuScenes"),
        ("ego_pose", "[]", "are not those of nuScenes: KeyError"),
        ("sample_data", "[]", "CAM_FRONT"),
    ],
)
def test_damaged_tables(nuscenes: Path, name: str, text: str, message: str) -> None:
    (nuscenes / "v1.0-mini" / f"{name}.json").write_text(text)
    with pytest.raises(SequenceError, match=message):
        open_sequence(nuscenes, "scene-0061")
