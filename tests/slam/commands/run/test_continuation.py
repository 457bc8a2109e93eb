"""A run that was killed goes on in its own folder, and leaves what an uninterrupted one leaves."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam import run_slam
from slam.frames import Frame
from slam.pipeline import batch
from slam.pipeline.checkpoint import SessionCheckpoint
from slam.pipeline.observer import Observer
from slam.results.folder import RunFolder
from slam.runtime.errors import ConfigError, RunError, SequenceError, SlamError
from slam.runtime.run_files import DRIVE, KEYFRAMES_PART

KILLED = """
import os, signal, sys
from pathlib import Path
from slam import run_slam
from slam.pipeline import batch
from slam.pipeline.observer import Observer

batch.EVERY_FRAMES = 4
add = Observer.add

def add_or_die(self, index, frame):
    if index == int(number):
        os.kill(os.getpid(), getattr(signal, name))
    add(self, index, frame)

Observer.add = add_or_die
root, weights, output, number, name, *overrides = sys.argv[1:]
run_slam(root, "sim", weights=weights, output=Path(output), overrides=overrides, frames="0:13", seed=3)
"""
OVERRIDES = ("output.report=false", "output.keep=keyframes", "mapping.voxel_size_m=0.5", "depth.refine=none")
SAME = ("trajectory_optimised.tum.txt", "trajectory_network.kitti.txt", "graph.g2o", "loops.json", "config.yaml")


@pytest.fixture(scope="module")
def kill(kitti_root: Path, tiny_weights: Path) -> Callable[..., Path]:
    """Runs the 13 frames of a drive, whose state is kept every four, and ends them at one."""

    def killed(output: Path, frame: int, name: str = "SIGKILL", *overrides: str) -> Path:
        words = [kitti_root, tiny_weights, output, frame, name, *OVERRIDES, *overrides]
        ended = subprocess.run([sys.executable, "-c", KILLED, *map(str, words)], check=False, capture_output=True)
        expected = {"SIGKILL": -signal.SIGKILL, "SIGTERM": 143}
        assert ended.returncode == expected[name], ended.stderr.decode()
        return output

    return killed


@pytest.fixture(scope="module")
def killed_at_ten(kill: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], Path]:
    """Copies of a run that was killed at its frame 10."""
    output = kill(tmp_path_factory.mktemp("killed") / "run", 10)
    return lambda place: shutil.copytree(output, place)


@pytest.fixture(scope="module")
def whole(kitti_root: Path, tiny_weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without an interruption."""
    output = tmp_path_factory.mktemp("whole") / "run"
    options: dict[str, Any] = {"weights": tiny_weights, "output": output, "overrides": OVERRIDES, "seed": 3}
    return run_slam(kitti_root, "sim", frames="0:13", **options).path


def kept(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name == DRIVE or KEYFRAMES_PART.fullmatch(path.name))


def test_a_killed_run_goes_on_and_has_the_bytes_of_a_whole_one(
    killed_at_ten: Callable[[Path], Path], whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = killed_at_ten(tmp_path / "run")
    assert kept(output) == [DRIVE, "keyframes-000004.npz", "keyframes-000008.npz"]
    monkeypatch.setattr(batch, "EVERY_FRAMES", 2)
    metrics = run_slam(continues=output).metrics().tree()
    assert (metrics["status"], metrics["sequence"]["frames"], metrics["sequence"]["continued_at"]) == ("ok", 13, 8)
    assert metrics["provenance"]["seed"] == 3
    for name in SAME:
        assert (output / name).read_bytes() == (whole / name).read_bytes(), name
    assert metrics["map"] == RunFolder(whole).metrics().tree()["map"]
    assert {path.name for path in output.iterdir()} == {path.name for path in whole.iterdir()}


def test_states_are_kept_at_distances_that_grow(
    kitti_root: Path, tiny_weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    overrides = [*OVERRIDES, "keyframes.use=always", "mapping.enabled=false"]
    options: dict[str, Any] = {"weights": tiny_weights, "overrides": overrides, "frames": "0:13"}
    uninterrupted = run_slam(kitti_root, "sim", output=tmp_path / "whole", **options).path
    output, add = tmp_path / "run", Observer.add
    states: list[int] = []

    def add_or_end(self: Observer, index: int, frame: Frame | SequenceError) -> None:
        if DRIVE in kept(output):
            states.append(len(SessionCheckpoint.read(output / DRIVE).state.drive))
        if index == 12:
            raise RunError("ended")
        add(self, index, frame)

    monkeypatch.setattr(batch, "EVERY_FRAMES", 1)
    with monkeypatch.context() as patched, pytest.raises(RunError, match="ended"):
        patched.setattr(Observer, "add", add_or_end)
        run_slam(kitti_root, "sim", output=output, **options)
    assert states == [*range(1, 12), 11]
    metrics = run_slam(continues=output).metrics().tree()
    assert metrics["sequence"]["continued_at"] == 11
    for name in SAME:
        assert (output / name).read_bytes() == (uninterrupted / name).read_bytes(), name


def test_it_goes_on_from_another_folder_and_says_once_that_it_did_not_end(
    kitti_root: Path,
    tiny_weights: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    shutil.copytree(tiny_weights, here / "mine")
    shutil.copytree(kitti_root / "sequences/sim/image_2", here / "depth")
    there.mkdir()
    monkeypatch.chdir(here)

    def end(self: batch.SlamPipeline, *_: object) -> None:
        raise RunError("ended")

    overrides = [*OVERRIDES, "depth.source=png:depth", "mapping.enabled=false"]
    for image in (here / "depth").iterdir():
        cv2.imwrite(str(image), np.full((64, 208), 2560, np.uint16))
    with monkeypatch.context() as patched, pytest.raises(RunError, match="ended"):
        patched.setattr(batch.SlamPipeline, "estimate", end)
        run_slam(kitti_root, "sim", weights="mine", frames="0:6", overrides=overrides, output=there / "run")
    monkeypatch.chdir(there)
    assert run_slam(continues="run").metrics().tree()["provenance"]["weights"] == str(here / "mine")
    assert len([record for record in caplog.records if "files that are there are whole" in record.message]) == 1


def test_it_can_be_killed_again_or_have_kept_nothing_yet(
    kill: Callable[..., Path], whole: Path, tmp_path: Path, kitti_root: Path, tiny_weights: Path
) -> None:
    output = kill(tmp_path / "run", 2)
    assert kept(output) == []
    (output / ".1.2.partial.graph.g2o").write_text("half")
    named: dict[str, Any] = {"weights": tiny_weights, "frames": "0:13", "output": output, "continues": output}
    assert run_slam(kitti_root, "sim", **named).metrics().tree()["sequence"]["continued_at"] == 0
    assert (output / SAME[0]).read_bytes() == (whole / SAME[0]).read_bytes()
    assert not list(output.glob(".*"))
    with pytest.raises(RunError, match="would be lost"):
        run_slam(kitti_root, "sim", **named)


def test_a_run_that_was_killed_before_its_map_has_it_afterwards(
    kitti_root: Path, tiny_weights: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also without keyframes, which are not kept by default: it begins again."""
    overrides = ["output.report=false", "mapping.voxel_size_m=0.5", "depth.refine=none"]
    options: dict[str, Any] = {"weights": tiny_weights, "overrides": overrides, "frames": "0:13", "seed": 3}

    def end(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(batch.SlamPipeline, "fuse", end)
        run_slam(kitti_root, "sim", output=tmp_path / "run", **options)
    metrics = run_slam(continues=tmp_path / "run").metrics()
    assert metrics.status == "ok"
    assert metrics.map == RunFolder(whole).metrics().map


def test_a_run_that_was_asked_to_end_goes_on(kill: Callable[..., Path], tmp_path: Path) -> None:
    output = kill(tmp_path / "run", 9, "SIGTERM", "mapping.enabled=false")
    assert RunFolder.open(output).metrics().tree()["status"] == "failed"
    metrics = run_slam(continues=output).metrics().tree()
    assert (metrics["status"], metrics["sequence"]["continued_at"]) == ("ok", 8)


def test_a_run_beside_an_earlier_one_goes_on_and_replaces_it(
    killed_at_ten: Callable[[Path], Path], whole: Path, tmp_path: Path
) -> None:
    output = shutil.copytree(whole, tmp_path / "run")
    (output / "loops.json").write_text("{}")
    killed_at_ten(output / "unfinished")
    assert run_slam(continues=output / "unfinished").path == output
    assert not (output / "unfinished").exists()
    assert (output / "loops.json").read_bytes() == (whole / "loops.json").read_bytes()


def test_what_does_not_fit_is_refused(
    killed_at_ten: Callable[[Path], Path], tmp_path: Path, kitti_root: Path, tiny_weights: Path
) -> None:
    output = killed_at_ten(tmp_path / "run")
    with pytest.raises(RunError, match="was ended before its last frame: let it go on first"):
        run_slam(kitti_root, "sim", weights=tiny_weights, frames="13:14", continues=output)
    with pytest.raises(RunError, match="run with other weights"):
        run_slam(weights="sim", continues=output)
    with pytest.raises(ConfigError, match="visual_odometry cannot be changed"):
        run_slam(overrides=["visual_odometry.enabled=false"], continues=output)
    (output / DRIVE).write_bytes(b"PK")
    with pytest.raises(RunError, match=r"drive\.zip is damaged"):
        run_slam(continues=output)
    (output / DRIVE).unlink()
    metrics = json.loads((output / "metrics.json").read_text())
    metrics["provenance"]["recording"]["dataset"] = str(tmp_path / "nowhere")
    (output / "metrics.json").write_text(json.dumps(metrics))
    with pytest.raises(SlamError, match="no data set at"):
        run_slam(continues=output)
