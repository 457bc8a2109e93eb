"""Point clouds of depth, and their registration with true depth."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from slam.frames import Intrinsics
from slam.sequences.simulation.street import SimulatedStreet, SimulationOptions

TOOL = Path(__file__).parents[2] / "tools" / "kiss_icp_on_learned_depth.py"


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location(TOOL.stem, TOOL)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_cloud_has_near_points_away_from_depth_edges(tool: ModuleType) -> None:
    depth = np.full((20, 30), 8.0, dtype=np.float32)
    depth[:, 10:20] = 16.0
    depth[:, 20:] = 90.0
    depth[:5] = 0.0
    camera = Intrinsics(60, 40, 50.0, 50.0, 29.5, 19.5)  # of an image twice as large
    points = tool.cloud(depth, camera, 40.0, 1.0, np.random.default_rng(0))
    assert set(points[:, 2]) == {8.0, 16.0}
    assert len(points) == 14 * (9 + 8)  # pixels on either side of every step are lost
    assert np.abs(points[points[:, 2] == 8.0, 0] - 8 * (-14.5 + 8) / 25).min() < 1e-9
    assert len(tool.cloud(depth, camera, 40.0, 0.5, np.random.default_rng(0))) == 119


def test_true_depth_gives_the_true_trajectory(tool: ModuleType) -> None:
    street = SimulatedStreet(SimulationOptions("straight", frames=12, seed=620))
    frames = [street.render(k) for k in range(12)]
    K = street.K
    camera = Intrinsics(416, 128, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    T_first_camera = tool.registered([frame.depth for frame in frames], camera, far_m=40.0, voxel_m=1.0, ratio=0.3)
    error = np.linalg.norm(T_first_camera[:, :3, 3] - street.T_world_camera[:, :3, 3], axis=1)
    assert error.max() < 0.1 * np.linalg.norm(street.T_world_camera[-1, :3, 3])


def test_a_second_run_reads_the_cache_of_the_first(
    tool: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--frames", "0:8", "--weights", "sim", "--cache", str(tmp_path / "cache"), "--columns", "120"]
    tables, entries = [], []
    for _ in range(2):
        tool.main([*words, "--set", "loops.enabled=false"])
        # the rounding of evo depends on what else the processor does
        tables.append(re.sub(r"\d\.\de-\d\d", "", capsys.readouterr().out))
        entries.append({path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("*") if path.is_file()})
    assert "kiss-icp, one unit" in tables[0] and tables[0] == tables[1]
    assert len(entries[0]) == 8 + 4 and entries[0] == entries[1], "one disparity a frame and one pose entry a snippet"
