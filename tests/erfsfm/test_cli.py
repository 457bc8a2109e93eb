"""The command line: help without heavy imports, errors in one line, results on stdout."""

from __future__ import annotations

import json
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
from safetensors.torch import load_file, save_file

from erfsfm.checkpoint import Model, build_networks, save_model
from erfsfm.cli import main
from erfsfm.config import NetworkConfig, dump_yaml, load_experiment
from erfsfm.model_record import ModelRecord
from erfsfm.networks.presets import PRESETS

Run = Callable[..., tuple[int, str, str]]
Refusal = Callable[..., str]
WriteRoot = Callable[..., Path]
TRAIN = [
    "train",
    "--config",
    "tiny",
    "--set",
    "training.steps=1",
    "--set",
    "data.workers=0",
    "--device",
    "cpu",
]
SMALL = ["--set", "network.height=32", "--set", "network.width=64", "--set", "training.batch=2"]


@pytest.fixture
def run(command_line: Run) -> Run:
    """Exit code, stdout and stderr of ``erfsfm ARGUMENTS``."""
    return partial(command_line, main, "erfsfm")


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    config = NetworkConfig(depth_width=0.0625, pose_width=0.125, height=32, width=64)
    record = ModelRecord(network=config, trained_on=["simulated/17"])
    save_model(tmp_path / "weights", Model(record, build_networks(config)))
    return tmp_path / "weights"


HELP = """
import sys, typer
from typer.testing import CliRunner
from erfsfm.cli import app

def walk(command, path):
    result = CliRunner().invoke(app, [*path, "--help"])
    assert result.exit_code == 0, (path, result.output)
    children = getattr(command, "commands", {})
    assert children or "Example:" in result.output, path
    print(" ".join(path))
    for name, child in children.items():
        walk(child, [*path, name])

walk(typer.main.get_command(app), [])
heavy = {"torch", "lightning", "cv2", "gtsam", "open3d", "matplotlib"} & set(sys.modules)
assert not heavy, heavy
"""


def test_help_of_every_command_loads_no_heavy_library():
    finished = subprocess.run(
        [sys.executable, "-c", HELP], capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr
    wanted = "train,predict,networks,receptive-field,convert,export,evaluate depth,evaluate pose"
    assert set(wanted.split(",")) <= set(finished.stdout.splitlines())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train", "--config", "nothing"], "no configuration file or name 'nothing'"),
        (["train", "--config", "tiny", "--dataset", "nowhere"], "does not exist"),
        (
            ["train", "--config", "tiny", "--set", "training.stepz=1"],
            "did you mean 'training.steps'",
        ),
        (["predict", "{image}"], "no weights 'default'"),
        (["predict", "nowhere.png", "--weights", "{weights}"], "nowhere.png"),
        (
            ["train", "--config", "tiny", "--dataset", "{root}", "--output", "new", "--resume"],
            "start without --resume",
        ),
        (["convert", "{image}", "--output", "new"], "damaged, no checkpoint"),
        (["export", "--weights", "{weights}", "--output", "net.pt"], "must end in .onnx"),
        (["receptive-field", "--output", "field.txt"], ".png, .pdf, .svg"),
        (["evaluate", "depth", "--dataset", "nowhere", "--weights", "{weights}"], "does not exist"),
        (
            [
                "evaluate",
                "pose",
                "--dataset",
                "{root}",
                "--sequence",
                "44",
                "--weights",
                "{weights}",
            ],
            "found 00",
        ),
    ],
)
def test_errors_are_one_line(
    run: Run,
    tmp_path: Path,
    weights: Path,
    write_root: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    words: str,
):
    import erfsfm.model_record

    monkeypatch.setattr(erfsfm.model_record, "SHIPPED", tmp_path / "none")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    write_root(tmp_path / "root", frames=5)
    places = {"weights": weights, "empty": tmp_path / "empty", "root": tmp_path / "root"}
    places["image"] = tmp_path / "root/sequences/00/image_2/000000.png"
    code, out, err = run(*(argument.format(**places) for argument in arguments))
    assert code == 1
    assert out == ""
    assert err.startswith("erfsfm: ")
    assert err.count("\n") == 1
    assert words.format(**places) in err


def test_networks_json(run: Run):
    code, out, err = run("networks", "--json", "--fidelity", "paper")
    assert (code, err) == (0, "")
    rows: list[dict[str, Any]] = json.loads(out)
    assert [row["name"] for row in rows] == [
        name for name, preset in PRESETS.items() if preset.encoder == "paper"
    ]
    assert all(
        {"name", "kind", "parameters", "multiply_adds", "receptive_field"} <= row.keys()
        for row in rows
    )
    (impossible,) = [row for row in rows if row["multiply_adds"] is None]
    assert impossible["name"] == "erf-depthnet-dilated"
    (reason,) = [value for key, value in impossible.items() if "reason" in key]
    assert "paper fidelity" in reason


@pytest.mark.slow
def test_receptive_field(run: Run, tmp_path: Path, weights: Path, write_root: Callable[..., Path]):
    images = write_root(tmp_path / "root", frames=6) / "sequences/00/image_2"
    picture = tmp_path / "new/field.png"
    plainly = "--network erf-posenet-dilated --height 64 --width 96 --output"
    options = [*plainly.split(), picture]
    plain = ["--network", "posenet", "--weights", weights, "--images", images]
    code, out, err = run("receptive-field", *plain, *options)
    assert (code, err) == (0, "")
    assert "erf-posenet-dilated (paper)" in out and str(weights) in out and "263 px" in out
    assert cv2.imread(str(picture)) is not None
    code, out, err = run("receptive-field", "--network", "erf-posenet-dfc", *options, "--json")
    assert (code, err) == (0, "")
    rows = json.loads(out)
    assert [row["theoretical_px"] for row in rows] == [511, 339, 301]
    assert {row["weights"] for row in rows} == {"untrained"}


def test_predict_leaves_out_what_it_cannot_read(
    run: Run, tmp_path: Path, weights: Path, caplog: pytest.LogCaptureFixture
):
    images, depth = tmp_path / "images", tmp_path / "depth"
    images.mkdir()
    for name in ("a.png", "b.png", "c.jpg"):
        cv2.imwrite(str(images / name), np.full((20, 30, 3), 99, np.uint8))
    (images / "b.png").write_bytes((images / "b.png").read_bytes()[:60])
    old = ["--seed", "3"]  # accepted where nothing is random
    code, out, _ = run("predict", images, "--weights", weights, "--output", depth, *old)
    assert code == 0 and f"depth of 2 images in {depth}" in out
    assert (
        "1 of 3 images cannot be read and are left out" in caplog.text
        and "b.png is truncated" in caplog.text
    )
    assert sorted(p.name for p in depth.iterdir()) == ["a.npy", "a.png", "c.npy", "c.png"]
    assert np.load(depth / "a.npy").shape == (20, 30)


def test_predict_does_not_overwrite_the_images(run: Run, tmp_path: Path, weights: Path):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((20, 30, 3), 99, np.uint8))
    before = (tmp_path / "a.png").read_bytes()
    code, _, err = run("predict", tmp_path, "--weights", weights, "--output", tmp_path)
    assert code == 1
    assert "overwritten" in err
    assert (tmp_path / "a.png").read_bytes() == before


@pytest.mark.parametrize("suffixes", [[".npy"], [".png"]])
def test_predict_replaces_earlier_predictions_alone(
    run: Run, tmp_path: Path, weights: Path, suffixes: list[str]
):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((20, 30, 3), 99, np.uint8))
    depth = tmp_path / "depth"
    given = ["predict", tmp_path / "a.png", "--weights", weights, "--output", depth]
    assert [run(*given)[0] for _ in range(2)] == [0, 0]
    shutil.rmtree(depth)
    depth.mkdir()
    np.save(depth / "a.npy", np.full((20, 30), 42, np.float32))
    cv2.imwrite(str(depth / "a.png"), np.full((20, 30, 3), 7, np.uint8))
    for path in depth.iterdir():
        if path.suffix not in suffixes:
            path.unlink()
    before = {path.name: path.read_bytes() for path in depth.iterdir()}
    code, _, err = run(*given)
    assert code == 1 and f"a{suffixes[0]} is no earlier prediction" in err
    assert {path.name: path.read_bytes() for path in depth.iterdir()} == before


def test_evaluate_depth(run: Run, tmp_path: Path, weights: Path, write_root: Callable[..., Path]):
    root = write_root(tmp_path / "root", frames=6, depth=True, seed=600)
    code, out, err = run("evaluate", "depth", "--weights", weights, "--dataset", root, "--json")
    assert (code, err) == (0, "")
    networks, median = json.loads(out)
    assert (networks["method"], median["method"]) == ("networks", "median depth map")
    assert networks["images"] == 2
    assert networks["leak"] is False
    assert median["abs_rel"] < 0.02


def test_evaluate_refuses_a_leak(
    run: Run, tmp_path: Path, weights: Path, write_root: Callable[..., Path]
):
    root = write_root(tmp_path / "root", frames=6, depth=True, seed=17)
    for verb in (("depth",), ("pose", "--sequence", "00")):
        arguments = ("evaluate", *verb, "--weights", weights, "--dataset", root, "--json")
        code, out, err = run(*arguments)
        assert (code, out) == (1, "")
        assert "simulated/17[0:6]" in err
        assert "--allow-leak" in err
        code, out, _ = run(*arguments, "--allow-leak")
        assert code == 0
        assert any(row["leak"] is True for row in json.loads(out))


def test_evaluate_pose(run: Run, tmp_path: Path, weights: Path, write_root: Callable[..., Path]):
    root = write_root(tmp_path / "root", frames=7, step=(0.0, 0.0, 0.1))
    code, out, _ = run(
        "evaluate", "pose", "--weights", weights, "--dataset", root, "--sequence", "00", "--json"
    )
    assert code == 0
    networks, straight = json.loads(out)
    assert networks["snippets"] == straight["snippets"] == 3
    assert straight["ate_mean"] == pytest.approx(0, abs=1e-9), "this drive is straight and steady"
    assert straight["re_mean"] == pytest.approx(0, abs=1e-9)
    assert networks["re_mean"] >= 0


def test_train_and_resume(run: Run, tmp_path: Path, write_root: Callable[..., Path]):
    root = write_root(tmp_path / "root", frames=6, seed=3)
    arguments = [*TRAIN, *SMALL, "--dataset", root, "--output", tmp_path / "run"]
    small = "network.depth_width=0.0625 network.pose_width=0.125"
    for change in f"{small} training.steps=2 training.checkpoint_every=1".split():
        arguments += ["--set", change]
    code, out, err = run(*arguments, "--seed", "5")
    assert code == 0 and all(line.startswith("steps") for line in err.splitlines()), (
        "said after ten seconds"
    )
    assert f"erfsfm evaluate depth --weights {tmp_path / 'run'}" in out, (
        "how to see how good they are"
    )
    code, _, err = run(*arguments)
    assert code == 1
    assert "--resume" in err
    code, _, _ = run(*arguments, "--set", "training.steps=3", "--resume")
    assert code == 0
    record = (tmp_path / "run" / "model.yaml").read_text()
    assert "step: 3" in record
    assert "command: erfsfm train --config tiny" in record.replace("\n  ", " ")


# user errors: one line with what was wanted, what came, and what to do


@pytest.fixture
def refusal(command_line: Callable[..., tuple[int, str, str]]) -> Refusal:
    """The one line of error of ``erfsfm ARGUMENTS``; nothing on stdout, exit code 1."""

    def call(*arguments: object) -> str:
        code, out, err = command_line(main, "erfsfm", *arguments)
        lines = [line for line in err.splitlines() if line.startswith("erfsfm: ")]
        assert (code, out, len(lines)) == (1, "", 1), err
        assert err.rstrip().endswith(lines[0]), "the error is the last line"
        return lines[0]

    return call


def test_images_of_mixed_size(
    refusal: Refusal, tmp_path: Path, write_root: WriteRoot, weights: Path
):
    root = write_root(tmp_path / "root", frames=5, size=(64, 96))
    odd = root / "sequences/00/image_2/000002.png"
    cv2.imwrite(str(odd), np.zeros((48, 96, 3), np.uint8))
    wanted = "000002.png is 96 x 48"
    assert wanted in refusal(*TRAIN, *SMALL, "--dataset", root, "--output", tmp_path / "run")
    assert wanted in refusal(
        "evaluate", "pose", "--dataset", root, "--sequence", "00", "--weights", weights
    )


@pytest.mark.parametrize(("kind", "value"), [("depth", float("nan")), ("pose", float("inf"))])
def test_weights_that_are_not_finite(
    refusal: Refusal, tmp_path: Path, write_root: WriteRoot, weights: Path, kind: str, value: float
):
    tensors = load_file(weights / f"{kind}.safetensors")
    next(iter(tensors.values())).view(-1)[0] = value
    save_file(tensors, weights / f"{kind}.safetensors")
    root = write_root(tmp_path / "root", frames=6, depth=True)
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((32, 64, 3), np.uint8))
    for arguments in (
        ["predict", tmp_path / "a.png", "--output", tmp_path / "depth"],
        ["evaluate", "depth", "--dataset", root],
        ["evaluate", "pose", "--dataset", root, "--sequence", "00"],
    ):
        error = refusal(*arguments, "--weights", weights)
        assert f"{kind}.safetensors" in error
    assert not (tmp_path / "depth").exists()


def test_an_output_with_other_peoples_files(refusal: Refusal, tmp_path: Path):
    files = {"config.yaml": dump_yaml(load_experiment("tiny")), "notes.txt": "mine"}
    output = tmp_path / "mine"
    output.mkdir()
    for name, text in files.items():
        (output / name).write_text(text)
    missing = tmp_path / "missing"  # the output is looked at before the data
    error = refusal(*TRAIN, *SMALL, "--dataset", missing, "--output", output)
    assert f"{output} holds files that 'erfsfm train' did not write" in error
    assert {
        str(path.relative_to(output)): path.read_text()
        for path in output.rglob("*")
        if path.is_file()
    } == files
