"""Whole runs with untrained networks; however one ends, its files are whole, and what it left can be used."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from safetensors.torch import load_file, save_file

from erfsfm.common.errors import BusyError
from erfsfm.common.readers.camera_file import CAMERA_FILE, UNKNOWN_FX_SIGMA, read_camera_file
from erfsfm.common.signals import Terminated
from slam import run_slam
from slam.commands.cli import main
from slam.commands.run import FolderRecorder, RunOptions, RunRequest
from slam.pipeline.observer import Observer
from slam.pipeline.run import SlamPipeline
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError, SlamError
from slam.sequences.camera_file import fixed_to, write_camera
from slam.simulation.options import SimulationOptions
from slam.simulation.street import SimulatedStreet

CheckRun = Callable[[Path], dict[str, Any]]
CopyRoot = Callable[[], Path]

NO_REPORT = "output.report=false"


@pytest.fixture(scope="module")
def run(
    kitti_root: Path, tiny_weights: Path, tmp_path_factory: pytest.TempPathFactory
) -> RunFolder:
    """One whole run with everything on. Not to be changed."""
    output = tmp_path_factory.mktemp("runs") / "run"
    return run_slam(
        kitti_root,
        "sim",
        weights=tiny_weights,
        output=output,
        seed=3,
        command="erfsfm-slam run ...",
    )


@pytest.fixture
def quick(kitti_root: Path, tiny_weights: Path, tmp_path: Path) -> dict[str, Any]:
    """Arguments of a run of a second: networks and graph alone."""
    overrides = [
        "mapping.enabled=false",
        "visual_odometry.enabled=false",
        f"output.root={tmp_path / 'results'}",
        NO_REPORT,
    ]
    return {
        "dataset": kitti_root,
        "sequence": "sim",
        "weights": tiny_weights,
        "overrides": overrides,
        "frames": "0:8",
    }


@pytest.fixture
def reported(quick: dict[str, Any]) -> dict[str, Any]:
    """The same with the report."""
    return quick | {"overrides": quick["overrides"][:-1]}


def test_every_file_and_every_number(run: RunFolder, check_run: CheckRun):
    metrics = check_run(run.path)
    provenance = metrics["provenance"]
    assert (provenance["seed"], provenance["device"]) == (3, "cpu")
    assert (
        provenance["command"] == "erfsfm-slam run ..."
        and provenance["weights_licence"] == "none, untrained"
    )
    assert re.fullmatch("[0-9a-f]{64}", provenance["weights_sha256"])
    assert provenance["trained_on"] == ["simulated/17"] and provenance["leak"] is False
    sequence = metrics["sequence"]
    assert (sequence["name"], sequence["frames"], sequence["fps"]) == (
        "sim",
        14,
        pytest.approx(10.0),
    )
    assert 9 < sequence["length_m"] < 18
    assert sum(metrics["timing"]["stages"].values()) <= metrics["timing"]["seconds_total"]
    assert metrics["trajectories"]["lidar"] is None
    for name in ("network", "odometry", "optimised"):
        assert metrics["trajectories"][name]["snippet5"]["count"] == 10
        assert metrics["trajectories"][name]["evo"]["difference"] < 1e-6
        assert "100 m" in metrics["trajectories"][name]["align"]["7dof"]["t_rel_percent_reason"]


def test_the_report_and_the_log_describe_it(run: RunFolder):
    report = (run.path / "report.html").read_text()
    assert "none, untrained" in report and ">FAILED<" not in report and ">LEAK<" not in report
    assert not re.search(r"(src|href)=['\"]https?:", report)
    assert "map is empty" in report, "an untrained network sees no world"
    assert "slam.graph.pose_graph: pose graph" in (run.path / "run.log").read_text()
    assert all(
        not isinstance(handler, logging.FileHandler)
        for handler in logging.getLogger("slam").handlers
    )


def test_the_snippets_of_the_network_are_its_direct_poses(run: RunFolder):
    """Cut from the chain they would be other numbers: poses of an untrained network are inconsistent."""
    numbers = run.metrics().tree()["trajectories"]
    assert numbers["network"]["snippet5"]["ate_mean"] != numbers["odometry"]["snippet5"]["ate_mean"]
    assert numbers["network"]["snippet5"]["ate_mean"] > 0


def test_without_map_and_truth_the_reasons_are_written(
    reported: dict[str, Any], copy_of_kitti_root: CopyRoot, check_run: CheckRun
):
    root = copy_of_kitti_root()
    (root / "poses" / "sim.txt").unlink()
    metrics = check_run(run_slam(**reported | {"dataset": root}).path)
    assert "mapping.enabled" in metrics["map"]["triangles_reason"]
    assert "no true poses" in metrics["sequence"]["length_m_reason"]
    assert metrics["graph"]["coverage"] is None
    assert metrics["trajectories"]["optimised"]["align"]["7dof"]["ate_rmse_m_reason"]


def test_a_run_that_fails_says_why_and_leaves_nothing_of_the_one_before(
    reported: dict[str, Any], copy_of_kitti_root: CopyRoot, tmp_path: Path
):
    root, output = copy_of_kitti_root(), tmp_path / "failed"
    whole = set(contents(run_slam(**reported, output=output).path))
    for image in sorted((root / "sequences" / "sim" / "image_2").glob("*.png"))[3:]:
        image.write_bytes(image.read_bytes()[:200])
    with pytest.raises(
        SlamError, match=r"no 5 usable frames in a row among 14: .*000003\.png is truncated"
    ):
        run_slam(**reported | {"dataset": root, "frames": None}, output=output)
    metrics = json.loads((output / "metrics.json").read_text())
    assert metrics["status"] == "failed" and "000003.png is truncated" in metrics["reason"]
    assert metrics["provenance"]["weights_licence"] == "none, untrained"
    report = (output / "report.html").read_text()
    assert ">FAILED<" in report and "000003.png is truncated" in report
    assert "the run failed" in (output / "run.log").read_text()
    assert yaml.safe_load((output / "config.yaml").read_text())["mapping"]["enabled"] is False
    assert not any(path.name.startswith("trajectory") for path in output.iterdir())
    assert (
        run_slam(**reported, output=output).metrics().status == "ok"
        and set(contents(output)) == whole
    )


def test_an_unreadable_image_is_bridged_and_reported(
    reported: dict[str, Any], copy_of_kitti_root: CopyRoot, check_run: CheckRun
):
    root = copy_of_kitti_root()
    image = root / "sequences" / "sim" / "image_2" / "000006.png"
    image.write_bytes(image.read_bytes()[:200])
    folder = run_slam(**reported | {"dataset": root, "frames": None})
    (gap,) = check_run(folder.path)["sequence"]["bridged"]
    assert (gap["first"], gap["last"]) == (6, 6) and "000006.png is truncated" in gap["reason"]
    assert folder.metrics().tree()["sequence"]["bridged_frames"] == 1
    for name in ("report.html", "run.log"):
        assert "000006.png is truncated" in (folder.path / name).read_text()


@pytest.mark.slow
def test_unreadable_scans_are_left_out_and_reported(
    reported: dict[str, Any], copy_of_kitti_root: CopyRoot, check_run: CheckRun
):
    root = copy_of_kitti_root()
    scans = root / "sequences/sim/velodyne"
    scans.mkdir()
    street = SimulatedStreet(SimulationOptions(route="straight", frames=14, seed=1001))
    for k in range(4, 8):
        street.scan(k).astype("<f4").tofile(scans / f"{k:06d}.bin")
    (scans / "000006.bin").write_bytes(b"12345")
    folder = run_slam(**reported | {"dataset": root, "frames": None})
    (gap,) = check_run(folder.path)["sequence"]["unreadable_scans"]
    assert (gap["first"], gap["last"]) == (6, 6) and "000006.bin is no Velodyne scan" in gap[
        "reason"
    ]
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
        (KeyboardInterrupt(), "KeyboardInterrupt"),
        (MemoryError(), "memory"),
        (ValueError("a bug"), "ValueError: a bug (test_run.py:"),
    ],
)
def test_however_a_run_ends_its_folder_has_the_reason(
    quick: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    reason: str,
):
    def stop(self: SlamPipeline, *_: object) -> None:
        raise error

    monkeypatch.setattr(SlamPipeline, "run", stop)
    with pytest.raises(type(error)):
        run_slam(**quick, output=tmp_path / "ended")
    metrics = RunFolder.open(tmp_path / "ended").metrics().tree()
    assert metrics["status"] == "failed" and reason in metrics["reason"]


def test_an_untrained_pose_network_with_two_sources_runs(
    reported: dict[str, Any],
    tmp_path: Path,
    write_weights: Callable[..., Path],
    check_run: CheckRun,
):
    metrics = check_run(
        run_slam(**reported | {"weights": write_weights(tmp_path / "three", sources=2)}).path
    )
    assert metrics["trajectories"]["network"]["snippet5"]["count"] == 4


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def call(*arguments: object) -> int:
    """Exit code of ``erfsfm-slam ARGUMENTS``."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as stopped:
        patch.setattr(sys, "argv", ["erfsfm-slam", *map(str, arguments)])
        main()
    return int(stopped.value.code or 0)


def test_images_without_a_camera_leave_one_for_the_next_run(
    quick: dict[str, Any], kitti_root: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    shutil.copytree(kitti_root / "sequences" / "sim" / "image_2", tmp_path / "walk" / "images")
    given = quick | {"dataset": tmp_path / "walk", "sequence": None}
    found = run_slam(**given, output=tmp_path / "first").path / CAMERA_FILE
    camera = read_camera_file(found)
    assert camera.fx == pytest.approx(camera.width / 2 / np.tan(np.deg2rad(65) / 2), abs=0.01)
    assert camera.fx_sigma == UNKNOWN_FX_SIGMA and camera.source is not None
    assert camera.source in caplog.text and "cannot be seen" in camera.source
    caplog.clear()
    fixed = np.zeros((camera.height, camera.width), np.bool_)
    fixed[-20:] = True
    write_camera(found.parent, camera, fixed)
    again = run_slam(**given, camera=found, output=tmp_path / "second").path
    assert "cannot be seen" not in caplog.text
    written = read_camera_file(again / CAMERA_FILE)
    assert written.mask == str(again / "mask.png")
    assert written == camera.model_copy(update={"mask": written.mask})
    kept = fixed_to(written, None)
    assert kept is not None and (kept == fixed).mean() > 0.97


def test_arguments_are_those_of_a_request_one_by_one():
    """So that an editor and mypy know them."""
    assert RunOptions.__annotations__.keys() == RunRequest.model_fields.keys() - {
        "command",
        "dataset",
        "sequence",
    }


@pytest.mark.parametrize(
    "option", [{"seed": -1}, {"frames": 8}, {"overrides": "a=b"}, {"progress": 5}]
)
def test_an_argument_of_another_kind_is_named(
    quick: dict[str, Any], option: dict[str, Any], tmp_path: Path
):
    with pytest.raises(RunError, match=f"run_slam: {next(iter(option))}: "):
        run_slam(**quick | {"output": tmp_path / "run"} | option)
    assert not (tmp_path / "run").exists()


def test_a_folder_of_another_program_is_refused_before_any_work(
    quick: dict[str, Any], tmp_path: Path
):
    (tmp_path / "config.yaml").write_text("mine")
    with pytest.raises(RunError, match="not empty and holds no run"):
        run_slam(**quick | {"weights": tmp_path / "nowhere"}, output=tmp_path)
    assert contents(tmp_path) == {"config.yaml": b"mine"}


def test_output_is_used_again_and_only_its_own_files_go(quick: dict[str, Any], tmp_path: Path):
    output = tmp_path / "mine"
    run_slam(**quick, output=output)
    (output / "map_mesh.ply").write_text("of an older run")
    (output / "notes.txt").write_text("what I saw")
    run_slam(**quick | {"frames": "0:7"}, output=output)
    assert RunFolder.open(output).metrics().tree()["sequence"]["frames"] == 7
    assert not (output / "map_mesh.ply").exists()
    assert (output / "notes.txt").read_text() == "what I saw"
    assert not (tmp_path / "results").exists()


def test_a_run_that_cannot_begin_leaves_an_earlier_one_as_it_is(
    quick: dict[str, Any], tmp_path: Path
):
    output = tmp_path / "run"
    run_slam(**quick, output=output)
    before = contents(output)
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "model.yaml").write_text("{")
    shutil.copytree(quick["weights"], tmp_path / "infinite")
    tensors = load_file(tmp_path / "infinite" / "pose.safetensors")
    next(value for value in tensors.values() if value.is_floating_point()).view(-1)[0] = float(
        "nan"
    )
    save_file(tensors, tmp_path / "infinite" / "pose.safetensors")
    for wish in (
        {"weights": tmp_path / "infinite"},
        {"frames": "0:2"},
        {"overrides": ["scale.mode=lidar"]},
        {"weights": tmp_path / "weights"},
        {"dataset": tmp_path / "nowhere"},
        {"overrides": ["map.nope=1"]},
    ):
        with pytest.raises(Exception, match=r".") as raised:
            run_slam(**quick | wish, output=output)
        assert "\n" not in str(raised.value)
        assert contents(output) == before


@pytest.mark.parametrize(
    "stage",
    [
        "graph",
        "map",
        *(pytest.param(stage, marks=pytest.mark.slow) for stage in ("loops", "report")),
    ],
)
def test_a_stage_that_fails_costs_its_results(
    stage: str,
    quick: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
):
    def failing(*_: object, **__: object) -> None:
        raise KeyError(0)

    place = {
        "loops": "slam.pipeline.run.close_loops",
        "graph": "slam.graph.pose_graph.PoseGraph.optimise",
        "map": "slam.pipeline.run.SlamPipeline.fuse",
        "report": "slam.commands.run.write_report",
    }
    monkeypatch.setattr(place[stage], failing)
    words = ["--dataset", quick["dataset"], "--weights", quick["weights"], "--frames", "0:8"]
    assert (
        call("run", *words, "--set", "visual_odometry.enabled=false", "--output", tmp_path / "run")
        == 0
    )
    assert "failed: unexpected KeyError: 0 (test_run.py:" in caplog.text
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert (
        metrics["status"] == "ok"
        and metrics["trajectories"]["optimised"]["align"]["7dof"]["ate_rmse_m"] > 0
    )
    lost = {
        "loops": [("loops", "accepted")],
        "graph": [("loops", "accepted"), ("graph", "nodes")],
        "map": [("map", "triangles")],
    }
    for part, name in lost.get(stage, []):
        assert metrics[part][name] is None and "KeyError" in metrics[part][f"{name}_reason"]
    assert (tmp_path / "run/report.html").is_file() == (stage != "report")
    assert (tmp_path / "run/graph.g2o").is_file() == (stage != "graph")


@pytest.mark.usefixtures("as_in_the_foreground")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_during_the_pass_leaves_a_whole_run_of_what_was_seen(
    quick: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    name: str,
):
    def interrupted(self: FolderRecorder, observer: Observer) -> None:
        if observer.frames == 6:
            os.kill(os.getpid(), getattr(signal, name))

    monkeypatch.setattr(FolderRecorder, "frame", interrupted)
    folder = run_slam(**quick, output=tmp_path / "run")
    metrics = folder.metrics()
    assert (metrics.status, metrics.sequence.frames) == ("ok", 6)
    assert "the first 6 of 8 frames" in caplog.text
    assert all(
        len(folder.trajectory(each) or ()) == 6 for each in ("network", "optimised", "reference")
    )


def test_a_signal_before_the_first_snippet_ends_a_run(
    quick: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(FolderRecorder, "frame", lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    with pytest.raises(SlamError, match="interrupted after 1 frames"):
        run_slam(**quick, output=tmp_path / "run")


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_terminated_run_has_its_reason(
    quick: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
):
    def terminated(self: SlamPipeline, *_: object) -> None:
        os.kill(os.getpid(), getattr(signal, name))

    monkeypatch.setattr(SlamPipeline, "fuse", terminated)
    with pytest.raises(Terminated) as raised:
        run_slam(**quick, output=tmp_path / "run")
    assert raised.value.code == 128 + getattr(signal, name)
    metrics = RunFolder.open(tmp_path / "run").metrics().tree()
    assert (metrics["status"], metrics["reason"]) == ("failed", f"ended by {name}")
    assert metrics["trajectories"]["optimised"]["align"] and metrics["map"] is None


KILLED = """
import os, signal, sys
from pathlib import Path
from slam import run_slam
from slam.pipeline.run import SlamPipeline

def kill(*_):
    os.kill(os.getpid(), signal.SIGKILL)

SlamPipeline.fuse = kill
root, weights, output = sys.argv[1:]
run_slam(root, "sim", weights=weights, output=Path(output), frames="0:8", overrides=["visual_odometry.enabled=false"])
"""


@pytest.mark.slow
def test_a_run_that_was_killed_in_its_map_can_be_used_and_replaced(
    quick: dict[str, Any],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
):
    output = tmp_path / "run"
    arguments = [str(quick["dataset"]), str(quick["weights"]), str(output)]
    assert (
        subprocess.run([sys.executable, "-c", KILLED, *arguments], check=False).returncode
        == -signal.SIGKILL
    )
    assert RunFolder.open(output).metrics().tree()["status"] == "estimated"
    images = quick["dataset"] / "sequences" / "sim" / "image_2"
    run = (
        "run",
        "--dataset",
        quick["dataset"],
        "--weights",
        quick["weights"],
        "--set",
        "mapping.enabled=false",
    )
    for numbers in ("estimated", "running", "absent"):
        if numbers == "running":
            (output / "metrics.json").write_text(
                '{"schema": 1, "status": "running", "provenance": {"weights_sha256": "00"}}'
            )
        elif numbers == "absent":
            (output / "metrics.json").unlink()
        caplog.clear()
        capsys.readouterr()
        assert call("evaluate", output, "--json") == 0
        assert caplog.text.count("\n") == 1 and "files that are there are whole" in caplog.text
        (entry,) = json.loads(capsys.readouterr().out)
        assert entry["status"] != "ok"
        if numbers == "estimated":
            assert entry["trajectories"]["optimised"]["align"]["7dof"]["ate_rmse_m"] > 0
    assert call("localize", images / "000003.png", "--map", output) == 0
    (output / "metrics.json").write_text(
        '{"schema": 1, "status": "running", "provenance": {"weights_sha256": "00"}}'
    )
    assert call(*run, "--frames", "0:8", "--output", output) == 0
    assert RunFolder.open(output).metrics().tree()["status"] == "ok"


def test_two_runs_into_one_folder(quick: dict[str, Any], tmp_path: Path):
    output, refused = tmp_path / "run", []

    def second(*_: object) -> None:
        if not refused:
            with pytest.raises(BusyError, match="another process writes to") as error:
                run_slam(**quick, output=output)
            refused.append(error)

    run_slam(**quick, output=output, progress=second)
    assert len(refused) == 1 and RunFolder.open(output).metrics().tree()["status"] == "ok"
    assert run_slam(**quick, output=output).metrics().tree()["status"] == "ok"
