import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from slam.runtime.errors import SequenceError
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import write_kitti_root
from slam.simulation.street import SimulatedStreet


def test_kitti_root_holds_what_was_rendered(tmp_path: Path):
    street = SimulatedStreet(SimulationOptions("straight", 3, 712, 208, 64))
    root, written = tmp_path / "deep" / "world", []
    write_kitti_root(
        street, root, depth=True, lidar=True, progress=lambda *said: written.append(said[1])
    )
    assert written == [1, 2, 3]
    assert sorted(p.name for p in root.iterdir()) == [
        "camera.yaml",
        "poses",
        "sequences",
        "simulation.json",
    ]
    sequence, depth = root / "sequences" / "sim", street.depth(2)
    image = cv2.imread(str(sequence / "image_2" / "000002.png"))[..., ::-1]
    assert np.array_equal(image, street.render(2))
    encoded = cv2.imread(str(sequence / "depth_2" / "000002.png"), cv2.IMREAD_UNCHANGED)
    assert encoded.dtype == np.uint16 and ((encoded == 0) == (depth == 0)).all()
    assert np.abs(encoded / 256.0 - depth).max() <= 0.5 / 256 + 1e-6
    scan = np.fromfile(sequence / "velodyne" / "000001.bin", np.float32).reshape(-1, 4)
    assert np.array_equal(scan, street.scan(1))
    assert np.loadtxt(sequence / "times.txt") == pytest.approx([0.0, 0.1, 0.2])
    assert np.loadtxt(root / "poses" / "sim.txt").reshape(3, 3, 4) == pytest.approx(
        street.T_world_camera[:, :3]
    )
    rows = dict(line.split(": ") for line in (sequence / "calib.txt").read_text().splitlines())
    assert list(rows) == ["P0", "P1", "P2", "P3", "Tr"] and rows["P0"] == rows["P2"]
    assert np.fromstring(rows["P2"], sep=" ").reshape(3, 4)[:, :3] == pytest.approx(street.K)
    assert np.fromstring(rows["Tr"], sep=" ").reshape(3, 4) == pytest.approx(
        street.T_camera_lidar[:3]
    )
    camera = yaml.safe_load((root / "camera.yaml").read_text())
    assert (camera["width"], camera["height"], camera["model"]) == (208, 64, "pinhole")
    assert camera["camera_height_m"] == pytest.approx(street.camera_height_m)
    assert json.loads((root / "simulation.json").read_text())["seed"] == 712
    with pytest.raises(SequenceError, match="not empty"):
        write_kitti_root(street, root)
