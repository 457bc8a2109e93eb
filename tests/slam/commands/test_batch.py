"""Many drives: manifests, failures apart from results, resumption, workers that die, processes that end with them."""

from __future__ import annotations

import csv
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from slam.commands import batch
from slam.commands.batch import (
    Drive,
    Outcome,
    check_output,
    drives_of,
    run_drive,
    run_drives,
    spread,
)
from slam.commands.cli import main
from slam.results.folder import RunFolder
from slam.runtime.errors import RunError, SequenceError

CommandLine = Callable[..., tuple[int, str, str]]
OFF = "mapping.enabled=false visual_odometry.enabled=false output.report=false"
QUICK = [word for change in OFF.split() for word in ("--set", change)]

UNITS_WITHOUT_METRES = ("camera heights", "the networks' own unit")


def silent(stage: str, done: int, total: int) -> None:
    """No progress bar."""


def test_a_manifest_names_drives(tmp_path: Path):
    manifest = tmp_path / "a.csv"
    manifest.write_text(
        "dataset, sequence, camera, options\nkitti,09,,--frames 0:90\nwalk.mp4,,c.yaml,\nother/walk.mp4,,,\n"
    )
    found = drives_of(manifest, ["all"], ["--seed", "3"])
    assert [drive.name for drive in found] == ["09", "walk", "walk-2"]
    wanted = "--dataset kitti --sequence 09 --seed 3 --frames 0:90"
    assert " ".join(found[0].arguments) == wanted
    assert {drive.folder for drive in found} == {tmp_path}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "names no drive"),
        ("dataset,weight\na,b", "'weight' is no key"),
        ("dataset,options\na,--set 'x", "options are not understood"),
        ("dataset,name\na,x\nb,x", "two drives are named x"),
    ],
)
def test_a_manifest_that_is_not_understood(tmp_path: Path, text: str, said: str):
    path = tmp_path / "drives.csv"
    path.write_text(text)
    with pytest.raises(SequenceError, match=said):
        drives_of(path, ["all"], [])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--set scale.mode=best", "got 'best'"),
        ("--weights none", "no weights 'none'"),
        ("--frames 5", "is not a range"),
    ],
)
def test_wrong_options_of_all_drives_are_refused_before_anything_is_written(
    tmp_path: Path, command_line: CommandLine, words: str, said: str
):
    manifest, output = tmp_path / "drives.csv", tmp_path / "out"
    manifest.write_text("dataset\na\nb\n")
    code, _, err = command_line(
        main, "erfsfm-slam", "batch", manifest, "--output", output, *words.split()
    )
    assert code == 1 and said in err and err.count("\n") == 1 and not output.exists()


def test_sequences_of_a_data_set(kitti_root: Path):
    (drive,) = drives_of(kitti_root, ["all"], [])
    assert drive.name == "sim" and drive.arguments[:2] == ("--dataset", str(kitti_root.absolute()))
    with pytest.raises(SequenceError, match="has no sequence 12: it has sim"):
        drives_of(kitti_root, ["12"], [])
    with pytest.raises(SequenceError, match=r"no manifest .*none\.csv: check the path"):
        drives_of(kitti_root / "none.csv", ["all"], [])


def test_a_later_batch_adds_its_drives_to_those_of_earlier_ones(
    tmp_path: Path, make_run: Callable[..., RunFolder], monkeypatch: pytest.MonkeyPatch
):
    """A drive that is named again has the row of the later batch; rows of runs say how far to trust them."""
    whole = make_run()

    def ended(drive: Drive, output: Path, **_: object) -> Outcome:
        status = "whole" if drive.name == "c" else "failed"
        return Outcome(drive, whole.path, status, f"in {drive.arguments[0]}")

    monkeypatch.setattr(batch, "run_drive", ended)
    for names, folder in ("ab", "monday"), ("bc", "tuesday"):
        drives = [Drive(name, tmp_path, (folder,)) for name in names]
        run_drives(drives, tmp_path / "out", 1, None, silent)
    with (tmp_path / "out/drives.csv").open() as file:
        rows = list(csv.DictReader(file))
    reasons = [(row["drive"], row["reason"]) for row in rows]
    assert reasons == [("a", "in monday"), ("b", "in tuesday"), ("c", "in tuesday")]
    assert "% too short" in rows[2]["doubts"] and not rows[0]["doubts"]
    assert {"confidence", "path", "mean_speed", "top_speed"} <= rows[2].keys()


@pytest.mark.slow
def test_failures_are_told_apart_and_whole_runs_are_kept(
    kitti_root: Path, tiny_weights: Path, tmp_path: Path
):
    manifest, output = tmp_path / "drives.csv", tmp_path / "out"
    manifest.write_text(f"name,dataset\ngood,{kitti_root}\nbad,nowhere\n")
    words = [*QUICK, "--weights", str(tiny_weights), "--frames", "0:6"]
    command = [sys.executable, *f"-m slam batch {manifest} --output {output}".split(), *words]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "1 of 2 drives failed" in ended.stderr and "no data set at nowhere" in ended.stdout
    with (output / "drives.csv").open() as file:
        rows = {row["drive"]: row for row in csv.DictReader(file)}
    assert rows["good"]["status"] == "whole" and rows["good"]["frames"] == "6"
    assert rows["bad"]["status"] == "failed" and "no data set at nowhere" in rows["bad"]["reason"]
    written = (output / "good" / "metrics.json").stat().st_mtime_ns

    (good, _) = drives_of(manifest, ["all"], [*words, *["--seed", "0", "--device", "auto"]])
    assert run_drive(good, output).status == "kept"
    assert (output / "good" / "metrics.json").stat().st_mtime_ns == written


def test_a_drive_that_needs_too_much_memory_is_ended(
    kitti_root: Path, tiny_weights: Path, tmp_path: Path
):
    """What an earlier run left, which was ended before its map, is no whole run."""
    (sim,) = drives_of(
        kitti_root, ["all"], [*QUICK, "--weights", str(tiny_weights), "--frames", "0:6"]
    )
    (tmp_path / "sim").mkdir()
    command = shlex.join(["erfsfm-slam", "run", *sim.arguments, "--output", str(tmp_path / "sim")])
    ended = {"status": "estimated", "provenance": {"command": command}}
    (tmp_path / "sim" / "metrics.json").write_text(json.dumps(ended))
    (outcome,) = run_drives([sim], tmp_path, 1, None, silent, threads=1, memory_gib=0.05)
    assert outcome.status == "failed" and "more than the 0.1 GiB of --memory" in outcome.reason
    assert "more than the 0.1 GiB" in (tmp_path / "drives.csv").read_text()
    check_output(tmp_path, [sim])


def test_paths_of_the_command_line_are_seen_from_where_it_is_given(
    kitti_root: Path,
    tiny_weights: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command_line: CommandLine,
):
    here, data = tmp_path / "here", tmp_path / "data"
    shutil.copytree(tiny_weights, here / "mine")
    shutil.copytree(kitti_root, data / "root")
    quick = (
        "mapping: {enabled: false}\nvisual_odometry: {enabled: false}\n"
        "output: {report: false}\nscale: {mode: none}\n"
    )
    (here / "mine.yaml").write_text(quick + "depth: {frame_stride: 3}\n")
    (data / "mine.yaml").write_text(quick + "depth: {frame_stride: 7}\n")
    words = "batch ../data/root --weights mine --config mine.yaml --frames 0:6 --output out"
    monkeypatch.chdir(here)
    code, out, err = command_line(main, "erfsfm-slam", *words.split())
    assert code == 0, out + err
    assert "frame_stride: 3" in (here / "out/sim/config.yaml").read_text()
    with (here / "out" / "drives.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["scale"], row["ate_6dof_m"]) == ("none", "") and row["unit"] in UNITS_WITHOUT_METRES
    assert float(row["ate_7dof_m"]) > 0


@pytest.mark.parametrize("name", ["drives.csv", "sim.log"])
def test_files_of_somebody_else_are_not_replaced(tmp_path: Path, kitti_root: Path, name: str):
    drives = drives_of(kitti_root, ["all"], [])
    check_output(tmp_path, drives)
    with pytest.raises(RunError, match=r"a drive is named drives\.csv"):
        check_output(tmp_path, [replace(drives[0], name="drives.csv")])
    (tmp_path / name).write_text("my own")
    with pytest.raises(RunError, match=f"{name} is none of ours"):
        check_output(tmp_path, drives)
    with pytest.raises(RunError, match="is a file: give a folder"):
        check_output(tmp_path / name, drives)


def dies_once(drive: Drive) -> Outcome:
    """The first worker that gets this is killed."""
    path = drive.folder / drive.name
    if path.name == "1" and not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if path.name == "2":
        raise ValueError("a drive that fails")
    return Outcome(drive, path, "whole")


@pytest.mark.slow
def test_the_drive_of_a_killed_worker_is_run_again(tmp_path: Path):
    pytest.importorskip("dask.distributed")
    drives = [Drive(str(n), tmp_path, ()) for n in range(4)]
    results = dict(spread(dies_once, drives, count=2))
    assert isinstance(results.pop(drives.pop(2)), ValueError)
    assert results == {each: Outcome(each, tmp_path / each.name, "whole") for each in drives}


def test_a_drive_ends_with_its_worker(tmp_path: Path):
    """Its standard input is closed as by the death of the worker; else it would wait for images for an hour."""
    words = [str(tmp_path / "lock"), "live", "--dataset", str(tmp_path), "--wait", "3600"]
    command = [sys.executable, "-m", "slam.commands.batch", *words]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        while not (tmp_path / "lock").exists() and process.poll() is None:
            time.sleep(0.05)
        _, said = process.communicate(timeout=120)
    assert process.returncode in (-signal.SIGTERM, 128 + signal.SIGTERM), said
