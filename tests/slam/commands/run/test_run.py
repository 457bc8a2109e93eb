"""Whole runs from a data set and weights to a run folder, with untrained networks."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from erfsfm.common.signals import Terminated
from slam import run_slam
from slam.pipeline.run import SlamPipeline
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError, SlamError
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

CheckRun = Callable[[Path], dict[str, Any]]
CopyRoot = Callable[[], Path]

NO_REPORT = "output.report=false"


@pytest.fixture(scope="module")
def run(kitti_root: Path, tiny_weights: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """One whole run with everything on. Not to be changed."""
    output = tmp_path_factory.mktemp("runs") / "run"
    return run_slam(kitti_root, "sim", weights=tiny_weights, output=output, seed=3, command="erfsfm-slam run ...")


@pytest.fixture
def quick(kitti_root: Path, tiny_weights: Path, tmp_path: Path) -> dict[str, Any]:
    """Arguments of a run of a second: networks and graph alone."""
    overrides = [
        "mapping.enabled=false",
        "visual_odometry.enabled=false",
        f"output.root={tmp_path / 'results'}",
        NO_REPORT,
    ]
    return {"dataset": kitti_root, "sequence": "sim", "weights": tiny_weights, "overrides": overrides, "frames": "0:6"}


@pytest.fixture
def reported(quick: dict[str, Any]) -> dict[str, Any]:
    """The same with the report."""
    return quick | {"overrides": quick["overrides"][:-1]}


def test_every_file_and_every_number(run: RunFolder, check_run: CheckRun) -> None:
    metrics = check_run(run.path)
    provenance = metrics["provenance"]
    assert (provenance["seed"], provenance["device"]) == (3, "cpu")
    assert provenance["command"] == "erfsfm-slam run ..." and provenance["weights_licence"] == "none, untrained"
    assert re.fullmatch("[0-9a-f]{64}", provenance["weights_sha256"])
    assert provenance["trained_on"] == ["simulated/17"] and provenance["leak"] is False
    sequence = metrics["sequence"]
    assert (sequence["name"], sequence["frames"], sequence["fps"]) == ("sim", 14, pytest.approx(10.0))
    assert 9 < sequence["length_m"] < 18
    assert sum(metrics["timing"]["stages"].values()) <= metrics["timing"]["seconds_total"]
    assert metrics["trajectories"]["lidar"] is None
    for name in ("network", "odometry", "optimised"):
        assert metrics["trajectories"][name]["snippet5"]["count"] == 10
        assert metrics["trajectories"][name]["evo"]["difference"] < 1e-6
        assert "100 m" in metrics["trajectories"][name]["align"]["7dof"]["t_rel_percent_reason"]


def test_the_report_and_the_log_describe_it(run: RunFolder) -> None:
    report = (run.path / "report.html").read_text()
    assert "none, untrained" in report and ">FAILED<" not in report and ">LEAK<" not in report
    assert not re.search(r"(src|href)=['\"]https?:", report)
    assert "map is empty" in report, "an untrained network sees no world"
    assert "slam.graph.pose_graph: pose graph" in (run.path / "run.log").read_text()
    assert all(not isinstance(handler, logging.FileHandler) for handler in logging.getLogger("slam").handlers)


def test_the_snippets_of_the_network_are_its_direct_poses(run: RunFolder) -> None:
    """Cut from the chain they would be other numbers: poses of an untrained network are inconsistent."""
    numbers = run.metrics().tree()["trajectories"]
    assert numbers["network"]["snippet5"]["ate_mean"] != numbers["odometry"]["snippet5"]["ate_mean"]
    assert numbers["network"]["snippet5"]["ate_mean"] > 0


def test_without_map_and_truth_the_reasons_are_written(
    reported: dict[str, Any], copy_of_kitti_root: CopyRoot, check_run: CheckRun
) -> None:
    root = copy_of_kitti_root()
    (root / "poses" / "sim.txt").unlink()
    metrics = check_run(run_slam(**reported | {"dataset": root}).path)
    assert "mapping.enabled" in metrics["map"]["triangles_reason"]
    assert "no true poses" in metrics["sequence"]["length_m_reason"]
    assert metrics["graph"]["coverage"] is None
    assert metrics["trajectories"]["optimised"]["align"]["7dof"]["ate_rmse_m_reason"]


def test_a_run_that_fails_says_why_and_keeps_what_it_has(
    reported: dict[str, Any], copy_of_kitti_root: CopyRoot, tmp_path: Path
) -> None:
    root = copy_of_kitti_root()
    for image in sorted((root / "sequences" / "sim" / "image_2").glob("*.png"))[3:]:
        image.write_bytes(image.read_bytes()[:200])
    output = tmp_path / "failed"
    with pytest.raises(SlamError, match=r"no 5 usable frames in a row among 14: .*000003\.png is truncated"):
        run_slam(**reported | {"dataset": root, "frames": None}, output=output)
    metrics = json.loads((output / "metrics.json").read_text())
    assert metrics["status"] == "failed" and "000003.png is truncated" in metrics["reason"]
    assert metrics["provenance"]["weights_licence"] == "none, untrained"
    report = (output / "report.html").read_text()
    assert ">FAILED<" in report and "000003.png is truncated" in report
    assert "the run failed" in (output / "run.log").read_text()
    assert yaml.safe_load((output / "config.yaml").read_text())["mapping"]["enabled"] is False
    assert not any(path.name.startswith("trajectory") for path in output.iterdir())
    assert run_slam(**reported, output=output).metrics().status == "ok"


def test_an_unreadable_image_is_bridged_and_reported(
    reported: dict[str, Any], copy_of_kitti_root: CopyRoot, check_run: CheckRun
) -> None:
    root = copy_of_kitti_root()
    image = root / "sequences" / "sim" / "image_2" / "000006.png"
    image.write_bytes(image.read_bytes()[:200])
    folder = run_slam(**reported | {"dataset": root, "frames": None})
    (gap,) = check_run(folder.path)["sequence"]["bridged"]
    assert (gap["first"], gap["last"]) == (6, 6) and "000006.png is truncated" in gap["reason"]
    assert folder.metrics().tree()["sequence"]["bridged_frames"] == 1
    for name in ("report.html", "run.log"):
        assert "000006.png is truncated" in (folder.path / name).read_text()


def test_unreadable_scans_are_left_out_and_reported(
    reported: dict[str, Any], copy_of_kitti_root: CopyRoot, check_run: CheckRun
) -> None:
    root = copy_of_kitti_root()
    scans = root / "sequences/sim/velodyne"
    scans.mkdir()
    street = SimulatedStreet(SimulationOptions(route="straight", frames=14, seed=1001))
    for k in range(4, 8):
        street.scan(k).astype("<f4").tofile(scans / f"{k:06d}.bin")
    (scans / "000006.bin").write_bytes(b"12345")
    folder = run_slam(**reported | {"dataset": root, "frames": None})
    (gap,) = check_run(folder.path)["sequence"]["unreadable_scans"]
    assert (gap["first"], gap["last"]) == (6, 6) and "000006.bin is no Velodyne scan" in gap["reason"]
    for name in ("report.html", "run.log"):
        assert "000006.bin is no Velodyne scan" in (folder.path / name).read_text()
    for scan in scans.iterdir():
        scan.write_bytes(b"12345")
    again = reported | {"dataset": root, "frames": None}
    metrics = check_run(run_slam(**again).path)
    assert metrics["trajectories"]["lidar_reason"].startswith("4 of 4 LiDAR scans cannot be read")
    with pytest.raises(SlamError, match=r"scale\.mode=lidar: 4 of 4 LiDAR scans cannot be read"):
        run_slam(**again | {"overrides": [*reported.get("overrides", ()), "scale.mode=lidar"]})


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (Terminated(15), "ended by SIGTERM"),
        (KeyboardInterrupt(), "KeyboardInterrupt"),
        (MemoryError(), "memory"),
        (ValueError("a bug"), "ValueError: a bug (test_run.py:"),
        (RunError("x"), "x"),
    ],
)
def test_however_a_run_ends_its_folder_has_the_reason(
    quick: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, reason: str
) -> None:
    def stop(self: SlamPipeline, *_: object) -> None:
        raise error

    monkeypatch.setattr(SlamPipeline, "run", stop)
    with pytest.raises(type(error)):
        run_slam(**quick, output=tmp_path / "ended")
    metrics = RunFolder.open(tmp_path / "ended").metrics().tree()
    assert metrics["status"] == "failed" and reason in metrics["reason"]


def test_an_untrained_pose_network_with_two_sources_runs(
    reported: dict[str, Any], tmp_path: Path, write_weights: Callable[..., Path], check_run: CheckRun
) -> None:
    metrics = check_run(run_slam(**reported | {"weights": write_weights(tmp_path / "three", sources=2)}).path)
    assert metrics["trajectories"]["network"]["snippet5"]["count"] == 2
