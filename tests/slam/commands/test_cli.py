"""The command line: light help, one line for an error, results on stdout."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import slam
import slam.commands.run
from slam.commands.cli import main
from slam.commands.run import RunRequest
from slam.config.sections import load_config
from slam.evaluation.trajectory import trajectory_metrics
from slam.formats.trajectory import read_trajectory
from slam.results.folder import RunFolder

Call = Callable[..., tuple[int, str, str]]
MakeRun = Callable[..., RunFolder]

VERBS = {"run", "evaluate", "export", "simulate", "localize", "config", "doctor"}
OFF = ("mapping.enabled", "visual_odometry.enabled", "output.report")
QUICK = " ".join(f"--set {setting}=false" for setting in OFF).split()


@pytest.fixture
def call(command_line: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Call:
    """Exit code, stdout and stderr of ``erfsfm-slam ARGUMENTS`` in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("KITTI_ODOMETRY", raising=False)
    return partial(command_line, main, "erfsfm-slam")


HELP = """
import sys, typer
from typer.testing import CliRunner
from slam.commands.cli import app

verbs = typer.main.get_command(app).commands
assert CliRunner().invoke(app, ["--help"]).exit_code == 0
assert "pydantic" not in sys.modules  # typer imports it for a verb
for verb in verbs:
    result = CliRunner().invoke(app, [verb, "--help"])
    assert result.exit_code == 0 and "Example: erfsfm-slam " + verb in result.output, (verb, result.output)
    print(verb)
libraries = {"torch", "lightning", "cv2", "gtsam", "open3d", "evo", "matplotlib", "plotly", "scipy", "numpy", "rich"}
heavy = libraries & set(sys.modules)
assert not heavy, heavy
"""


def test_help_of_every_verb_is_light():
    finished = subprocess.run(
        [sys.executable, "-c", HELP], capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr
    assert set(finished.stdout.split()) >= VERBS


@pytest.mark.parametrize(
    "words",
    [
        "",
        "fly",
        "run --seed -1",
        "evaluate a.txt b.txt c.txt",
        "evaluate . --fail-over a=1",
        "evaluate . --csv a",
    ],
)
def test_wrong_usage_exits_with_2(call: Call, words: str):
    code, out, err = call(*words.split())
    assert code == 2 and "Usage:" in out + err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "--dataset", "nowhere"], "no data set at nowhere"),
        (["run", "--sequence", "09"], "KITTI_ODOMETRY"),
        (["run", "--weights", "nowhere"], "no weights 'nowhere'"),
        (["run", "--set", "mapping.voxel=1"], "mapping.voxel"),
        (["run", "--camera", "camera.yaml"], "--dataset"),
        (["run", "--frames", "9:3"], "A must come before B"),
        (["evaluate", "a.txt", "b.txt"], "b.txt: no such file"),
        (["evaluate", "."], "not a run folder"),
        (
            ["export", "nowhere", "--what", "mesh", "--output", "m.ply"],
            "nowhere is not a run folder",
        ),
        (["simulate", "world", "--route", "maze"], "maze"),
        (["simulate", "world", "--frames", "20"], "a loop closes within 250"),
    ],
)
def test_a_known_error_is_one_line_and_exits_with_1(
    call: Call, arguments: list[str], words: str, tmp_path: Path
):
    code, out, err = call(*arguments)
    assert code == 1 and out == ""
    assert err.startswith("erfsfm-slam: ") and err.count("\n") == 1 and words in err
    assert list(tmp_path.iterdir()) == []


def test_run_prints_table_licence_and_place(call: Call, kitti_root: Path, tiny_weights: Path):
    arguments = ["run", "--dataset", kitti_root, "-s", "sim", "--weights", tiny_weights]
    arguments += ["--frames", "0:6", *QUICK]
    code, out, err = call(*arguments, "--output", "my run", "--set", "scale.mode=none", "--seed", 5)
    assert (code, err) == (0, "")
    for name in ("network", "odometry", "optimised"):
        assert re.search(rf"^\s*{name}\s+[\d.]+", out, re.MULTILINE)
    assert "sim, scale none" in out and "networks' own unit" in out
    assert "none, untrained" in out and "LEAK" not in out
    assert "6 frames in" in out and "my run" in out and "report.html" not in out
    folder = RunFolder.open(Path("my run"))
    metrics, path = folder.metrics().tree(), folder.trajectory("optimised")
    assert metrics["provenance"]["seed"] == 5
    motion = metrics["motion"]
    assert path is not None and motion["path"] == pytest.approx(path.length_m, rel=1e-4)
    seconds = path.stamps[-1] - path.stamps[0]
    assert motion["mean_speed"] == pytest.approx(path.length_m / seconds, rel=1e-4)
    assert motion["standing_share"] == 0.0
    assert re.search(r"^estimated path: \S+ the networks' own unit, ", out, re.MULTILINE)
    assert shlex.split(metrics["provenance"]["command"]) == [
        "erfsfm-slam",
        *map(str, arguments),
        *["--output", "my run", "--set", "scale.mode=none", "--seed", "5"],
    ]
    named = {"dataset": str(kitti_root.absolute()), "sequence": "sim", "frames": "0:6"}
    assert metrics["provenance"]["recording"] == named
    code, out, err = call("export", "my run", "--what", "nerfstudio", "--output", "scene")
    assert code == 0 and "scene" in out and len(list(Path("scene/images").iterdir())) == 6, err


def test_run_prints_interpolated_gaps(
    call: Call, copy_of_kitti_root: Callable[[], Path], tiny_weights: Path
):
    root = copy_of_kitti_root()
    (root / "sequences" / "sim" / "image_2" / "000007.png").write_bytes(b"no image")
    code, out, _ = call(
        "run", "--dataset", root, "--weights", tiny_weights, "--output", "run", *QUICK
    )
    assert code == 0 and re.search(r"^INTERPOLATED: frames 7: .*000007\.png", out, re.MULTILINE)


def test_a_run_without_truth_has_no_table_of_dashes(
    call: Call, copy_of_kitti_root: Callable[[], Path], tiny_weights: Path
):
    root = copy_of_kitti_root()
    (root / "poses" / "sim.txt").unlink()
    code, out, _ = call(
        "run", "--dataset", root, "--weights", tiny_weights, "--set", "mapping.enabled=false"
    )
    assert (
        code == 0
        and "sim, scale camera-height: no errors, for the sequence has no true poses" in out
    )
    assert "–" not in out and "14 frames in" in out


def test_run_stamps_a_leak_and_prints_json(call: Call, kitti_root: Path, leaky_weights: Path):
    arguments = ["run", "--dataset", kitti_root, "--weights", leaky_weights, "--frames", "0:6"]
    arguments += QUICK
    assert "LEAK" in call(*arguments)[1]
    code, out, _ = call(*arguments, "--json", "--output", "again")
    assert code == 0 and json.loads(out) == RunFolder.open(Path("again")).metrics().tree()
    assert Path("results/latest").resolve().name.endswith("_sim")


def test_an_interrupted_run_says_so(call: Call, monkeypatch: pytest.MonkeyPatch):
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(slam.commands.run, "perform", interrupt)
    code, _, err = call("run")
    assert code == 130 and "interrupted; what was written stays" in err


def files_of(run: RunFolder, kind: str = "tum") -> tuple[Path, Path]:
    return run.path / f"trajectory_optimised.{kind}.txt", run.path / f"reference.{kind}.txt"


@pytest.mark.parametrize("kind", ["tum", pytest.param("kitti", marks=pytest.mark.slow)])
def test_evaluate_files(call: Call, make_run: MakeRun, kind: str):
    estimate, reference = files_of(make_run(), kind)
    code, out, _ = call("evaluate", estimate, reference, "--json")
    expected = trajectory_metrics(
        read_trajectory(estimate, kind), read_trajectory(reference, kind)
    ).tree()
    assert code == 0 and json.loads(out) == expected
    code, table, _ = call("evaluate", estimate, reference, "--format", kind)
    assert code == 0
    assert f"{expected['align']['7dof']['ate_rmse_m']:.3f}" in table
    assert f"evo_ape {kind} " in table and "--align --correct_scale" in table


def test_fail_over(call: Call, make_run: MakeRun):
    files = files_of(make_run())
    assert call("evaluate", *files, "--fail-over", "ate_rmse_m=1000")[0] == 0
    code, out, err = call(
        "evaluate", *files, "--json", "--fail-over", "ate_rmse_m=0", "--fail-over", "rpe_rot_deg=99"
    )
    assert (
        code == 1
        and "align.7dof.ate_rmse_m is " in err
        and "over the limit 0" in err
        and "rpe_rot_deg" not in err
    )
    assert json.loads(out)["align"]
    for limit, words in (("beauty=1", "no metric 'beauty'"), ("ate_rmse_m=few", "METRIC=VALUE")):
        code, _, err = call("evaluate", *files, "--fail-over", limit)
        assert code == 2 and words in " ".join(err.split())


def test_rows_without_stamps_have_those_of_a_file_of_times(call: Call, make_run: MakeRun):
    run = make_run().path
    rows = (run / "trajectory_optimised.tum.txt").read_text().splitlines()[1:]
    Path("half.txt").write_text("\n".join(rows[::2]))
    Path("times.txt").write_text("\n".join(row.split()[0] for row in rows))
    files = "half.txt", run / "trajectory_optimised.kitti.txt"
    code, out, _ = call("evaluate", *files, "--times", "times.txt", "--json")
    assert (code, json.loads(out)["align"]["none"]["ate_rmse_m"]) == (0, pytest.approx(0, abs=1e-6))


def test_evaluate_runs_side_by_side(call: Call, make_run: MakeRun):
    runs = [make_run(name).path for name in ("morning", "evening")]
    code, out, _ = call("evaluate", *runs)
    assert code == 0 and "morning" in out and "evening" in out and "optimised" in out
    assert [entry["run"] for entry in json.loads(call("evaluate", *runs, "--json")[1])] == list(
        map(str, runs)
    )


def test_evaluate_systems_against_one_reference(call: Call, make_run: MakeRun):
    """Files and runs in one table; several of one name as mean and deviation; frames and CSV."""
    run = make_run("ours")
    for k in range(3):
        text = (run.path / "trajectory_optimised.kitti.txt").read_text().splitlines(keepends=True)
        Path(f"orb_{k}.txt").write_text("".join(text[: len(text) // 2 if k == 2 else None]))
    truth = run.path / "reference.kitti.txt"
    rows = len(truth.read_text().splitlines())
    code, out, err = call(
        "evaluate", run.path, "orb=orb_[01].txt", "--reference", truth, "--csv", "a.csv"
    )
    assert (code, err) == (0, "") and "orb (2 runs)" in out and " ± 0.000" in out
    lines = Path("a.csv").read_text().splitlines()
    assert (
        len(lines) == 4
        and lines[0].startswith("system,path,poses,")
        and "align.6dof.t_rel_percent" in lines[0]
    )
    code, _, err = call("evaluate", "orb_2.txt", "--reference", truth)
    assert code == 1 and "orb_2.txt: the estimate has" in err and "--frames A:B" in err
    arguments = (
        "evaluate",
        run.path,
        "orb_2.txt",
        "--reference",
        run.path,
        "--frames",
        f"0:{rows // 2}",
    )
    code, out, _ = call(*arguments, "--json")
    assert code == 0 and [each["poses"] for each in json.loads(out)] == [rows // 2] * 2
    assert json.loads(out)[1]["align"]["7dof"]["ate_rmse_m"] == pytest.approx(
        json.loads(out)[0]["align"]["7dof"]["ate_rmse_m"]
    )
    assert call(*arguments, "--fail-over", "ate_rmse_m=0")[0] == 1
    for words, wanted in (
        (("no=*.none",), "no file or folder is named *.none"),
        (("a.txt",), "a.txt: no such file"),
    ):
        code, _, err = call("evaluate", *words, "--reference", truth)
        assert code == 1 and err.count("\n") == 1 and wanted in err
    for folder in ("a", "b"):
        shutil.copytree(run.path, f"{folder}/same")
    words = "orb=orb_[01].txt", "a/same", "b/same", "--reference", truth, "--json"
    systems = [each["system"] for each in json.loads(call("evaluate", *words)[1])]
    assert systems == ["orb", "orb", "a/same", "b/same"]
    shutil.copy("orb_0.txt", "orb [1].txt")
    assert call("evaluate", "orb=orb [1].txt", "--reference", truth)[0] == 0
    code, _, err = call("evaluate", "/dev/urandom", "--reference", truth)
    assert code == 1 and "/dev/urandom: larger than" in err
    code, _, err = call("evaluate", run.path, "--reference", truth, "--csv", "orb_0.txt")
    assert code == 1 and "choose another" in err


def test_the_printed_configuration_reads_back(call: Call):
    Path("mine.yaml").write_text(call("config")[1])
    assert load_config("mine.yaml") == load_config()


def test_old_command_lines_with_seed_and_device_still_work(call: Call, make_run: MakeRun):
    run = make_run()
    for words in (
        ("evaluate", *files_of(run)),
        ("export", run.path, "--what", "cloud", "--output", "map.ply"),
        ("simulate", "world", "--width", 104, "--height", 32, "--frames", 5, "--route", "straight"),
    ):
        assert call(*words, "--seed", 3, "--device", "cpu")[0] == 0


@pytest.mark.slow
def test_localize_prints_a_row_an_image(call: Call, kitti_root: Path, tiny_weights: Path):
    run = ["run", "--dataset", kitti_root, "--weights", tiny_weights, "--output", "run", *QUICK]
    assert call(*run)[0] == 0
    images = kitti_root / "sequences" / "sim" / "image_2"
    code, out, err = call("localize", images, "--map", "run", "--frames", "11:14")
    assert (
        (code, err) == (0, "")
        and "of 3 images found" in out
        and re.search(r"^\s*000013\.png ", out, re.MULTILINE)
    )
    code, out, _ = call("localize", images / "000003.png", "--map", "run", "--json")
    assert code == 0 and [entry["image"] for entry in json.loads(out)] == ["000003.png"]
    assert call("localize", images, "--map", images)[0] == 1
    cv2.imwrite("plain.png", np.full((64, 208, 3), 128, np.uint8))
    code, out, _ = call("localize", "plain.png", "--map", "run")
    assert code == 1 and "0 of 1 images found" in out
    reference = Path("run/reference.tum.txt").read_bytes()
    code, _, err = call("localize", images, "--map", "run", "--output", "run/reference.tum.txt")
    assert (
        code == 1
        and "is a file of a run" in err
        and Path("run/reference.tum.txt").read_bytes() == reference
    )


@pytest.mark.slow
def test_simulate_writes_a_root_that_runs(call: Call, tiny_weights: Path):
    size = ("--width", 104, "--height", 32, "--frames", 8, "--route", "straight", "--seed", 1003)
    code, out, err = call(
        "simulate", "world", *size, "--depth", "--lidar", "--hazards", "rain,exposure"
    )
    assert (code, err) == (0, "") and "--dataset world" in out
    for folder in ("image_2", "depth_2", "velodyne"):
        assert len(list(Path(f"world/sequences/sim/{folder}").iterdir())) == 8
    assert call("simulate", "world", *size)[0] == 1  # never over what is there
    assert call("run", "--dataset", "world", "--weights", tiny_weights, *QUICK)[0] == 0


def test_doctor(call: Call, kitti_root: Path):
    code, out, _ = call("doctor", "--dataset", kitti_root)
    assert code == 0 and "sequence sim: 14 frames" in out
    code, out, _ = call("doctor", "--dataset", "nowhere")
    assert code == 1 and "nowhere" in out.splitlines()[-1]
    code, out, _ = call("doctor", "--dataset", kitti_root, "--camera", "fov=700")
    assert code == 1 and "700" in out.splitlines()[-1]


def test_a_request_names_its_recording(tmp_path: Path):
    given = RunRequest.of(dataset=str(tmp_path), camera="fov=70", frames="0:9")
    assert given.recording == {"dataset": str(tmp_path), "camera": "fov=70", "frames": "0:9"}
