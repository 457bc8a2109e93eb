"""The benchmark's plan, rows and tables without any run; then one real run, twice."""

from __future__ import annotations

import csv
import importlib
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.formats.trajectory import Trajectory
from slam.geometry.se3 import from_rotation_vector, invert
from slam.results.folder import RunFolder
from slam.results.metrics import Metrics, Provenance, ScaleMetrics, SequenceMetrics
from slam.runtime.storage.record import Missing

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))  # as ``python tools/benchmark.py`` finds its modules
benchmark = importlib.import_module("benchmark")
page, pairs, plan, work = (
    importlib.import_module(f"benchmarking.{name}") for name in ("page", "pairs", "plan", "work")
)


def metrics(ate: float = 1.0, seconds: float = 20.0, **stages: float) -> Metrics:
    """The metrics of a run that the tables read."""
    alignments = {how: {"ate_rmse_m": ate, "scale": 1.1, "r_rel_deg_per_100m": 0.5} for how in ("6dof", "7dof")}
    tree = {
        "status": "ok",
        "provenance": {"leak": False},
        "sequence": {"frames": 100, "length_m": 90.0},
        "timing": {
            "seconds_total": seconds,
            "frames_per_second": 100 / seconds,
            "cpu_seconds": 10.0,
            "peak_rss_mb": 500.0,
            "stages": stages,
        },
        "scale": {"mode": "camera-height", "unit": "metres", "value": 1.0},
        "trajectories": {name: {"align": alignments} for name in ("network", "odometry", "optimised")},
        "graph": {"coverage": {"95": 0.9}},
        "loops": {"accepted": 3},
        "map": {"triangles": None, "triangles_reason": "no map"},
    }
    return Metrics.model_validate(tree)


@pytest.fixture
def job(tmp_path: Path) -> Any:
    drive = plan.BenchmarkSequence("loop 610", tmp_path / "world")
    return plan.Job(tmp_path / "runs", drive, "sim", plan.EVERYTHING, 0)


def results_of(job: Any, ates: dict[str, Sequence[float]]) -> list[Any]:
    """Results of configurations, one per seed."""
    return [
        work.JobResult(replace(job, configuration=plan.Configuration(name), seed=seed), metrics(ate), "abc")
        for name, values in ates.items()
        for seed, ate in enumerate(values)
    ]


def cells(table: str) -> list[list[str]]:
    """Rows of the first Markdown table, its head first."""
    lines = [line for line in table.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_plan_has_every_combination(tmp_path: Path) -> None:
    drives = [plan.BenchmarkSequence(name, tmp_path) for name in ("a", "b")]
    jobs = plan.plan(tmp_path, drives, plan.ABLATION, ["sim", "default"], [0, 1, 2], ["loops.min_inliers=25"])
    assert len(jobs) == len({job.place for job in jobs}) == 2 * 2 * 3 * len(plan.ABLATION)
    assert {job.configuration.name for job in jobs[:12]} == {plan.EVERYTHING.name}
    assert all(job.arguments[-2:] == ["--set", "loops.min_inliers=25"] for job in jobs)


def test_hazards_are_all_at_once_and_name_their_clean_drive(tmp_path: Path) -> None:
    clean, hard = plan.worlds(tmp_path, ["loop"], [620], 800, ["clean", "hazards"])
    assert clean.root.name == "loop-620-800-v1"
    assert hard.root.name == "loop-620-800-hazards-v1"
    assert (hard.clean, hard.kind) == (clean.name, "loop, hazards")
    assert hard.simulate == (*clean.simulate, "--hazards", "moving-cars,exposure,blur,stop,rain")


def test_full_size_has_worlds_and_originals_of_kitti(tmp_path: Path) -> None:
    for root, name in zip(plan.ORIGINALS, ("00", "03"), strict=True):
        images = tmp_path / "data" / root / "sequences" / name / "image_2"
        images.mkdir(parents=True)
        cv2.imwrite(str(images / "000000.png"), np.zeros((375, 1242, 3), np.uint8))
    words = ["full-size", "--data", str(tmp_path / "data"), "--output", str(tmp_path / "out")]
    options = benchmark._parser().parse_args(words)
    jobs = benchmark._jobs(options)
    names = [job.drive.name for job in jobs]
    assert names == ["loop 610", "loop 611", "straight 610", "straight 611", "KITTI 00", "KITTI 03"]
    assert jobs[0].drive.root.name == "loop-610-300-1242x375-v1"
    assert jobs[0].drive.simulate[-4:] == ("--width", "1242", "--height", "375")
    assert benchmark._command(options).startswith(
        "python tools/benchmark.py full-size --data DATA --routes loop straight"
    )
    text = page.section("full-size", "", [work.JobResult(job, metrics(), "abc") for job in jobs], "1")
    assert text.startswith("## Full-size") and "| KITTI 03 | default | 100 |" in text and "![" not in text


def test_accuracy_is_mean_and_deviation_over_the_seeds_that_ended_well(job: Any) -> None:
    results = results_of(job, {"default": [1.0, 3.0]})
    results.append(work.JobResult(replace(job, seed=2), Missing("out of memory"), "abc", "out of memory"))
    text = page.accuracy_tables(results)
    *_, head, row = cells(text)
    assert row[head.index("ATE 7-dof, optimised")] == "2.00 ± 1.41"
    assert row[head.index("scale")] == "1.100"
    assert "Failed: loop 610, sim, everything on, seed 2: out of memory" in text


def test_errors_relative_to_path_and_network(tmp_path: Path) -> None:
    (tmp_path / "metrics.json").write_text("{}")
    run = metrics(ate=0.9)
    slower = metrics(ate=3.6).trajectories.network
    run = run.changed(trajectories=run.trajectories.model_copy(update={"network": slower}))
    derived = work.derive_metrics(tmp_path, run)
    shares = derived.network_percent, derived.optimised_percent, derived.of_network
    assert shares == pytest.approx((4.0, 1.0, 0.25))
    assert derived.false_loops == Missing("the sequence has no true poses")
    run = run.changed(sequence=SequenceMetrics(length_m=Missing("no truth")))
    assert work.derive_metrics(tmp_path, run).optimised_percent == Missing("no truth")


@pytest.mark.parametrize(
    ("moved_m", "turned_deg", "false"), [(0.0, 0.0, 0), (1.9, 4.9, 0), (2.1, 0.0, 1), (0.0, 5.1, 1)]
)
def test_true_and_false_loops(tmp_path: Path, moved_m: float, turned_deg: float, false: int) -> None:
    T_world_camera = np.tile(np.eye(4), (3, 1, 1))
    T_world_camera[:, :3, 3] = [[0, 0, 0], [4, 0, 0], [4, 0, 7]]
    T_world_camera[2, :3, :3] = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    off = from_rotation_vector(np.deg2rad([0.0, turned_deg, 0.0]), np.array([moved_m, 0.0, 0.0]))
    loops = [{"from": 1, "to": 2, "T_from_to": (invert(T_world_camera[1]) @ T_world_camera[2] @ off).tolist()}]
    (tmp_path / "metrics.json").write_text("{}")
    (tmp_path / "loops.json").write_text(json.dumps({"accepted": loops}))
    RunFolder(tmp_path).write_trajectory("reference", Trajectory(np.arange(3.0), T_world_camera))
    derived = work.derive_metrics(tmp_path, metrics())
    assert (derived.true_loops, derived.false_loops) == (1 - false, false)
    in_heights = metrics().changed(scale=ScaleMetrics(mode="none", unit="camera heights", value=1.0))
    assert isinstance(work.derive_metrics(tmp_path, in_heights).true_loops, Missing)


def test_a_leak_is_reported(job: Any) -> None:
    assert "LEAK" not in page.accuracy_tables([work.JobResult(job, metrics(), "abc")])
    leaky = metrics().changed(provenance=Provenance(leak=True))
    assert "LEAK: weights sim saw frames of loop 610" in page.accuracy_tables([work.JobResult(job, leaky, "abc")])


def test_ablation_compares_with_the_same_seed(job: Any) -> None:
    results = results_of(job, {plan.EVERYTHING.name: [1.0, 2.0], "no loops": [4.0, 2.0]})
    table = cells(page.ablation_tables(results))
    assert [row[:2] for row in table[1:3]] == [["everything on", "1.00 (1.00)"], ["no loops", "2.00 (4.00)"]]
    assert table[-2:] == [["everything on", "1.50"], ["no loops", "3.00"]]


def test_a_number_that_is_missing_has_its_reason_below(job: Any) -> None:
    text = page.maps_tables(results_of(job, {plan.EVERYTHING.name: [1.0]}))
    assert "– map triangles, loop 610: no map." in text


@pytest.mark.slow
def test_two_checkouts_in_turn(tmp_path: Path) -> None:
    report, here = tmp_path / "page.md", Path(__file__).parents[2]
    words = ["--against", str(here), "--frames", "12", "--pairs", "1"]
    benchmark.main(["speed", *words, "--output", str(tmp_path / "out"), "--report", str(report)])
    text = report.read_text()
    table = cells(text)
    head, row = table[0], table[1]
    cpu, busiest = (head.index(name) for name in ("CPU ms / frame", "CPU ms / frame of the busiest thread"))
    before, after = (float(part.split(":")[0]) for part in row[cpu].split(","))
    assert row[0] == "grid 610, 12 frames" and before > 0 and after > 0
    assert float(row[busiest].split(",")[0]) > 0
    assert "geometry" in table[2] and str(tmp_path) not in text


def test_a_failing_checkout_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"nonesuch by .* failed; see "):
        drive = pairs.Drive("nonesuch", ("--dataset", str(tmp_path / "missing")))
        pairs.in_turn([Path(__file__).parents[2]], [drive], 1, tmp_path)


def test_only_successful_runs_of_the_same_sources_are_kept(job: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    codes = iter([-9, 0, 0, 0])
    runs = []

    def run(words: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        runs.append(words)
        code = next(codes)
        if code == 0:
            (job.place / "run").mkdir()
            (job.place / "run" / "metrics.json").write_text(metrics().to_json())
        return subprocess.CompletedProcess(words, code, "", "")

    monkeypatch.setattr(work, "revision", lambda: "first")
    monkeypatch.setattr(work.subprocess, "run", run)
    work.perform(job)
    assert work.job_result(job).reason == "killed by SIGKILL"
    work.perform(job)
    work.perform(job)
    assert (len(runs), work.job_result(job).reason) == (2, "")
    work.perform(replace(job, device="cuda"))
    assert len(runs) == 3
    monkeypatch.setattr(work, "revision", lambda: "second")
    work.perform(replace(job, device="cuda"))
    assert len(runs) == 4


def test_dask_runs_every_job_once(tmp_path: Path) -> None:
    pytest.importorskip("dask.distributed")
    places = [tmp_path / str(n) for n in range(4)]
    with work.workers(2, None) as spread:
        assert sorted(spread(Path.mkdir, places)) == [(n, None) for n in range(4)]  # a second time would raise
    assert all(place.is_dir() for place in places)


@pytest.mark.slow
def test_one_real_run_and_one_that_fails(tmp_path: Path) -> None:
    words = ["accuracy", "--routes", "straight", "--worlds", "610", "--frames", "8", "--seeds", "0"]
    words += ["--weights", "sim", "nonesuch", "--set", "mapping.enabled=false", "--output", str(tmp_path / "out")]
    report = tmp_path / "page.md"
    benchmark.main([*words, "--report", str(report)])
    with (tmp_path / "out" / "accuracy.csv").open() as file:
        real, failed = csv.DictReader(file)
    assert (real["status"], real["frames"], failed["status"]) == ("ok", "8", "failed")
    assert 0 < float(real["ate_7dof_optimised_m"]) < 1
    assert "nonesuch" in failed["reason"]
    *_, head, real_row, failed_row = cells(report.read_text())
    assert [row[head.index("frames")] for row in (real_row, failed_row)] == ["8", "–"]
    assert str(tmp_path) not in report.read_text()
    assert "](images/trajectories.png)" in report.read_text()
    assert cv2.imread(str(tmp_path / "images" / "trajectories.png")).std() > 0

    (record,) = (tmp_path / "out" / "accuracy").glob("*sim*/record.json")
    before = record.stat().st_mtime_ns
    benchmark.main([*words, "--report", str(report)])
    assert record.stat().st_mtime_ns == before


def test_maps_need_depth_maps_beside_the_images_and_name_every_part(tmp_path: Path) -> None:
    (loop,) = plan.worlds(tmp_path, ["loop"], [610], 50, truth=("depth",))
    assert "--depth" in loop.simulate and loop.root.name.startswith("loop-610-50-depth-")
    (drive,) = plan.raw_drives([tmp_path / "drive_0013"])
    jobs = plan.plan(tmp_path, [loop, drive], plan.MAPS, ["default"], [0])
    assert len(jobs) == 2 * len(plan.MAPS)
    assert "--sequence" in jobs[0].arguments and "--sequence" not in jobs[1].arguments
    errors = {"accuracy_median_m": 0.1, "accuracy_90_m": 0.5, "completeness": 0.8, "f_score": {"0.2": 0.7, "0.5": 0.9}}
    results = [work.JobResult(job, Metrics.model_validate({"map": errors | {"submaps": 3}}), "abc") for job in jobs]
    text = page.maps_tables(results)
    assert "| loop 610 | default | no sky | 0.100 | 0.50 |" in text and "drive_0013" in text


def test_whole_sequences_of_kitti_begin_with_what_they_take_and_go_on_where_they_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world, root = tmp_path / "world", tmp_path / "root"
    shape = ("--route", "straight", "--width", "208", "--height", "64", "--frames", "8", "--seed", "1")
    work.simulate(plan.BenchmarkSequence("world", world, simulate=shape))
    (root / "poses").mkdir(parents=True)
    for name in ("05", "09"):
        shutil.copytree(world / "sequences" / "sim", root / "sequences" / name)
    shutil.copy(world / "poses" / "sim.txt", root / "poses" / "09.txt")
    page_of_runs = tmp_path / "page.md"
    words = ["kitti", "--kitti", str(root), "--output", str(tmp_path / "out"), "--report", str(page_of_runs)]
    benchmark.main(words)
    said = capsys.readouterr().err
    assert "not in" in said and "10, 00, 01, 02, 03, 04, 06, 07, 08" in said and "05, which has no true poses" in said
    assert "0 of 1 runs are done. To run: KITTI 09 (8); 8 frames, about 1 min" in said
    head, row = cells(page_of_runs.read_text())
    assert row[0] == "KITTI 09" and float(row[head.index("scale")]) > 0
    assert row[head.index("published, 7-dof")] == "–"  # 8 frames are not the sequence

    (record,) = (tmp_path / "out" / "kitti").glob("*/record.json")
    before = record.stat().st_mtime_ns
    benchmark.main(words)
    assert "1 of 1 runs are done. To run: none" in capsys.readouterr().err
    assert record.stat().st_mtime_ns == before


def test_whole_sequences_stand_beside_published_errors(job: Any) -> None:
    whole = metrics().changed(sequence=SequenceMetrics(frames=1591, length_m=1705.0))
    drive = plan.BenchmarkSequence("KITTI 09", job.drive.root)
    text = page.section("kitti", "", [work.JobResult(replace(job, drive=drive), whole, "abc")], "1")
    assert text.startswith("## KITTI\n") and "| 3.94 (GigaSLAM) |" in text
