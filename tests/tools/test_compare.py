"""The comparison with ORB-SLAM3: its tables from two trajectories, and a run where the other system is missing."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.formats.trajectory import Trajectory, write_tum
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.insert(0, str(TOOLS))
compare = importlib.import_module("compare")


def row(page: str, name: str) -> list[dict[str, str]]:
    """The rows of a recording, by the heads of their tables."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line[:2] == "| "]
    heads = [line for line in lines if line[0] == "recording"]
    return [dict(zip(head, line, strict=True)) for head, line in zip(heads, (x for x in lines if x[0] == name))]


def test_errors_are_over_the_frames_that_both_have(tmp_path: Path) -> None:
    """Ours is wrong at its first ten frames only, where the other system has no pose and another scale later."""
    stamps = np.arange(40.0)
    T_world_camera = np.tile(np.eye(4), (40, 1, 1))
    T_world_camera[:, 0, 3], T_world_camera[:, 2, 3] = np.sin(stamps / 9), stamps
    ours, other = T_world_camera.copy(), T_world_camera.copy()
    ours[:10, 1, 3] += 3.0
    other[:, :3, 3] *= 0.2
    drive = compare.BenchmarkSequence("KITTI 05", tmp_path)
    jobs = compare.plan(tmp_path / "out", [drive], (compare.WITH_MAP, *compare.WHOLE), ["sim"], [0])
    results = []
    for job in jobs:
        folder = RunFolder(job.place / "run")
        folder.path.mkdir(parents=True)
        errors = {how: {"ate_rmse_m": 1.25} for how in ("6dof", "7dof")}
        tree: dict[str, Any] = {"sequence": {"frames": 40, "length_m": 39.0}, "scale": {"unit": "metres"}}
        tree |= {"timing": {"seconds_total": 8.0, "cpu_seconds": 4.0, "peak_rss_mb": 500.0}, "map": {"triangles": 7}}
        folder.write_metrics(Metrics.model_validate(tree | {"trajectories": {"optimised": {"align": errors}}}))
        folder.write_trajectory("reference", Trajectory(stamps, T_world_camera))
        folder.write_trajectory("optimised", Trajectory(stamps, ours))
        (job.place / "record.json").write_text(json.dumps({"seconds": 9.0, "load": 1.0, "reason": "", "commit": "abc"}))
        results.append(compare.job_result(job))
    write_tum(tmp_path / "orb.tum", Trajectory(stamps[10:], other[10:]))
    record = {"cpu_s": 2.0, "peak_rss_mb": 300.0, "keyframes": 12, "points": 150}
    peer = compare.PeerRun(compare.read_trajectory(tmp_path / "orb.tum"), record)
    accuracy, cost = row(compare.page([compare.Pair("KITTI 05", *results, peer)], "", "abc"), "KITTI 05")
    assert (accuracy["poses, ours"], accuracy["poses, ORB-SLAM3"]) == ("40", "30")
    both = [accuracy[f"ATE, {whose}"] for whose in ("ours", "ORB-SLAM3")]
    assert all(float(error) < 1e-6 for error in both)
    assert float(accuracy["all frames, ours"]) > 0.5 and accuracy["all frames, 6-dof"] == "1.250"
    assert (cost["CPU ms / frame, ours"], cost["CPU, ORB-SLAM3"], cost["triangles, ours"]) == ("100.0", "50.0", "7")


@pytest.mark.slow
def test_a_machine_without_the_other_system_says_so_in_the_page(tmp_path: Path) -> None:
    """This environment has no pyorbslam3, so its Python is one that cannot run it."""
    words = ["--route", "straight", "--width", "208", "--height", "64", "--frames", "8", "--seed", "1"]
    world = tmp_path / "world"
    subprocess.run([sys.executable, "-m", "slam", "simulate", str(world), *words], check=True, capture_output=True)
    root = tmp_path / "data" / "kitti_odometry"
    (root / "sequences").mkdir(parents=True)
    (root / "poses").mkdir()
    (world / "sequences" / "sim").rename(root / "sequences" / "05")
    (world / "poses" / "sim.txt").rename(root / "poses" / "05.txt")
    page, vocabulary = tmp_path / "page.md", tmp_path / "voc.txt"
    vocabulary.write_text("10 6 0 0")
    options = ["--data", str(tmp_path / "data"), "--orb-python", sys.executable, "--vocabulary", str(vocabulary)]
    compare.main([*options, "--output", str(tmp_path / "out"), "--report", str(page)])
    text = page.read_text()
    accuracy, _ = row(text, "KITTI 05")
    assert (accuracy["poses, ours"], accuracy["poses, ORB-SLAM3"]) == ("8", "0")
    assert "ORB-SLAM3 failed on KITTI 05: ModuleNotFoundError: No module named 'pyorbslam3'" in text
    assert str(tmp_path) not in text
