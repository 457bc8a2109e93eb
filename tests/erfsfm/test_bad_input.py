"""What users get wrong, through the command line: one line that says what was wanted, what came, and what to do."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from erfsfm.checkpoint import Model, ModelRecord, build_networks, save_model
from erfsfm.cli import main
from erfsfm.config import NetworkConfig

Refusal = Callable[..., str]
WriteRoot = Callable[..., Path]
TRAIN = ["train", "--config", "tiny", "--set", "training.steps=1", "--set", "data.workers=0", "--device", "cpu"]
SMALL = ["--set", "network.height=32", "--set", "network.width=64", "--set", "training.batch=1"]


@pytest.fixture
def refusal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refusal:
    """The one line of error of ``erfsfm ARGUMENTS``; nothing on stdout, exit code 1."""

    def call(*arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", ["erfsfm", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            main()
        out, err = capsys.readouterr()
        lines = [line for line in err.splitlines() if line.startswith("erfsfm: ")]
        assert (stopped.value.code, out, len(lines)) == (1, "", 1), err
        assert "Traceback" not in err
        assert err.rstrip().endswith(lines[0]), "the error is the last word"
        return lines[0]

    return call


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    config = NetworkConfig(depth_width=0.0625, pose_width=0.125, height=32, width=64)
    save_model(tmp_path / "weights", Model(ModelRecord(network=config, trained_on=[]), *build_networks(config)))
    return tmp_path / "weights"


def test_a_snippet_shorter_than_asked(refusal: Refusal, tmp_path: Path, write_root: WriteRoot, weights: Path) -> None:
    root = write_root(tmp_path / "root", frames=4)
    error = refusal(*TRAIN, *SMALL, "--set", "network.sources=4", "--dataset", root, "--output", tmp_path / "run")
    assert "a snippet needs 5 consecutive frames; found kitti_odometry/00 (4 frames)" in error
    error = refusal("evaluate", "pose", "--dataset", root, "--sequence", "00", "--weights", weights)
    assert "kitti_odometry/00 has 4 frames; a snippet needs 5" in error


def test_images_of_mixed_size(refusal: Refusal, tmp_path: Path, write_root: WriteRoot, weights: Path) -> None:
    root = write_root(tmp_path / "root", frames=5, size=(64, 96))
    odd = root / "sequences/00/image_2/000003.png"
    cv2.imwrite(str(odd), np.zeros((48, 96, 3), np.uint8))
    wanted = (
        "000003.png is 96 x 48; the camera of kitti_odometry/00 is 96 x 64; all images of a recording need one size"
    )
    assert wanted in refusal(*TRAIN, *SMALL, "--dataset", root, "--output", tmp_path / "run")
    assert wanted in refusal("evaluate", "pose", "--dataset", root, "--sequence", "00", "--weights", weights)


def test_intrinsics_of_another_resolution(refusal: Refusal, tmp_path: Path) -> None:
    drive = tmp_path / "drive"
    (drive / "images").mkdir(parents=True)
    for index in range(6):
        cv2.imwrite(str(drive / f"images/{index}.png"), np.full((48, 96, 3), 10 * index, np.uint8))
    (drive / "camera.yaml").write_text("width: 192\nheight: 96\nfx: 100\nfy: 100\ncx: 96\ncy: 48\nfps: 10\n")
    error = refusal(*TRAIN, *SMALL, "--dataset", drive, "--output", tmp_path / "run")
    assert "is 96 x 48; the camera of folder/drive is 192 x 96" in error


@pytest.mark.parametrize("verb", ["predict", "export", "receptive-field"])
def test_weights_cut_in_half(refusal: Refusal, tmp_path: Path, weights: Path, verb: str) -> None:
    path = weights / "depth.safetensors"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((32, 64, 3), np.uint8))
    given = [tmp_path / "a.png"] if verb == "predict" else []
    output = {"predict": "depth", "export": "net.onnx", "receptive-field": "field.png"}[verb]
    error = refusal(verb, *given, "--weights", weights, "--output", tmp_path / output)
    assert "depth.safetensors is damaged" in error
    assert "copy it again or train anew" in error
    assert not (tmp_path / output).exists()


def test_weights_of_another_architecture(refusal: Refusal, tmp_path: Path, weights: Path) -> None:
    record = weights / "model.yaml"
    record.write_text(record.read_text().replace("pose: posenet", "pose: erf-posenet-dfc"))
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((32, 64, 3), np.uint8))
    error = refusal("predict", tmp_path / "a.png", "--weights", weights, "--output", tmp_path / "depth")
    assert "pose.safetensors is of another architecture than model.yaml says" in error


@pytest.mark.parametrize("key", ["depth", "pose"])
def test_an_unknown_preset(refusal: Refusal, tmp_path: Path, write_root: WriteRoot, key: str) -> None:
    root = write_root(tmp_path / "root", frames=5)
    error = refusal(*TRAIN, "--set", f"network.{key}=posnet", "--dataset", root, "--output", tmp_path / "run")
    assert "unknown network 'posnet' (did you mean 'posenet'?); known: depthnet" in error


@pytest.mark.parametrize(("key", "name", "known"), [("depth", "posenet", "depthnet"), ("pose", "depthnet", "posenet")])
def test_a_preset_of_the_other_kind(
    refusal: Refusal, tmp_path: Path, write_root: WriteRoot, key: str, name: str, known: str
) -> None:
    root = write_root(tmp_path / "root", frames=5)
    error = refusal(*TRAIN, "--set", f"network.{key}={name}", "--dataset", root, "--output", tmp_path / "run")
    assert f"network.{key} must be a {key} network ({known}, " in error
    assert f"got '{name}'" in error


def test_a_misspelt_key(refusal: Refusal, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("network:\n  hieght: 128\n")
    error = refusal("train", "--config", tmp_path / "mine.yaml", "--dataset", tmp_path)
    assert f"unknown key 'network.hieght' in {tmp_path}/mine.yaml; did you mean 'height'?" in error
