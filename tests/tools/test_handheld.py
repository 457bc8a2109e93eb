"""The benchmark of carried cameras, on tiny folders in the layouts of public data sets."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slam.formats.trajectory import Trajectory
from slam.geometry.se3 import FloatArray, from_rotation_vector
from slam.results.folder import RunFolder
from slam.results.metrics import Event, Metrics, SequenceMetrics, TrackingMetrics

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))  # as ``python tools/benchmark.py`` finds its modules
benchmark = importlib.import_module("benchmark")
handheld, page, work = (importlib.import_module(f"benchmarking.{name}") for name in ("handheld", "page", "work"))
FRAMES = 10


@pytest.fixture(scope="module")
def poses() -> FloatArray:
    """A camera that turns as it walks a curve, ``(FRAMES, 4, 4)``."""
    k = np.arange(FRAMES)
    zero = np.zeros(FRAMES)
    return from_rotation_vector(np.column_stack([zero, 0.1 * k, zero]), np.column_stack([np.sin(k), zero, 0.3 * k]))


def images(folder: Path, names: list[str], size: tuple[int, int] = (640, 480)) -> None:
    folder.mkdir(parents=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros(size[::-1], np.uint8))


def tum(root: Path, poses: FloatArray) -> None:
    """Truth begins with the third image, as where a tracker sees the camera late."""
    folder = root / "rgbd_dataset_freiburg1_xyz"
    stamps = 100.0 + np.arange(FRAMES) / 5
    images(folder / "rgb", [f"{k}.png" for k in range(FRAMES)])
    (folder / "rgb.txt").write_text("".join(f"{stamp:.6f} rgb/{k}.png\n" for k, stamp in enumerate(stamps)))
    RunFolder(folder).write_trajectory("groundtruth", Trajectory(stamps[2:], poses[2:]))
    (folder / "trajectory_groundtruth.tum.txt").rename(folder / "groundtruth.txt")


def seven_scenes(root: Path, poses: FloatArray) -> None:
    for sequence in ("seq-01", "seq-02"):
        folder = root / "chess" / sequence
        images(folder, [f"frame-{k:06d}.color.png" for k in range(FRAMES)])
        for k, pose in enumerate(poses):
            np.savetxt(folder / f"frame-{k:06d}.pose.txt", pose)


def euroc(root: Path) -> None:
    camera = root / "MH_01_easy" / "mav0" / "cam0"
    names = [f"{10**18 + k * 5 * 10**7}.png" for k in range(FRAMES)]
    images(camera / "data", names, (752, 480))
    (camera / "data.csv").write_text("#timestamp,filename\n" + "".join(f"{name[:-4]},{name}\n" for name in names))
    (camera / "sensor.yaml").write_text(
        "%YAML:1.0\nrate_hz: 20\nresolution: [752, 480]\ncamera_model: pinhole\n"
        "intrinsics: [458.6, 457.3, 367.2, 248.4]\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]\n"
    )


@pytest.fixture
def jobs(tmp_path: Path, poses: FloatArray) -> list[Any]:
    tum(tmp_path / "tum", poses)
    seven_scenes(tmp_path / "scenes", poses)
    euroc(tmp_path / "euroc")
    words = ["handheld", "--tum", str(tmp_path / "tum"), "--seven-scenes", str(tmp_path / "scenes")]
    words += ["--euroc", str(tmp_path / "euroc"), "--output", str(tmp_path / "out")]
    words += ["--rooms", "1", "2", "--motions", "phone", "--rates", "10", "--hazards", "clean", "people"]
    options = benchmark._parser().parse_args([*words, "--seconds", "15"])
    command = "python tools/benchmark.py handheld --tum TUM --seven-scenes SEVEN_SCENES --euroc EUROC "
    assert benchmark._command(options).startswith(command)
    jobs: list[Any] = benchmark._jobs(options)
    return jobs


def result(job: Any, events: list[Event], located: int = FRAMES) -> Any:
    metrics = Metrics(
        sequence=SequenceMetrics(frames=FRAMES), tracking=TrackingMetrics(events=events, located_frames=located)
    )
    return work.JobResult(job, metrics, "abc")


def test_every_sequence_of_a_root_is_a_row(jobs: list[Any]) -> None:
    names = [job.drive.name for job in jobs]
    assert names[0].startswith("TUM RGB-D") and names[3].startswith("EuRoC")
    assert [name.rpartition("/")[2] for name in names[1:3]] == ["seq-01", "seq-02"]
    assert names[4:] == [f"rooms {seed}, phone, 10 Hz{hazard}" for hazard in ("", ", people") for seed in (1, 2)]
    assert jobs[-1].drive.clean == names[5] and jobs[-1].drive.simulate[-2:] == ("--hazards", "people")
    assert jobs[-1].drive.simulate[5] == "150"
    text = page.handheld_tables([result(job, [Event(frame=2, event="map begun")]) for job in jobs[:4]])
    assert "ORB-SLAM3 loses five of nine" in text and "| TUM RGB-D | default |" in text


def test_errors_are_those_of_the_frames_with_a_true_pose(jobs: list[Any], poses: FloatArray) -> None:
    """A scaled and moved truth has no error, whatever the frames without a true pose do."""
    for job in jobs[:2]:
        estimate = poses.copy()
        estimate[:, :3, 3] *= 0.5
        run = RunFolder(job.place / "run")
        run.path.mkdir(parents=True)
        run.write_text("metrics.json", "{}")
        if job is jobs[0]:
            estimate[:2, :3, 3] = 9.0  # before the truth begins
        run.write_trajectory("optimised", Trajectory(np.arange(FRAMES) / 30, estimate))
        found = result(job, [])
        steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        known = steps[2:] if job is jobs[0] else steps
        assert handheld.PATH.value(found) == pytest.approx(known.sum(), abs=1e-6)
        assert handheld.ATE.value(found) == pytest.approx(0.0, abs=1e-6)
