"""User errors through the command line: one line with what was wanted, what came, and what to do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from safetensors.torch import load_file, save_file

from erfsfm.checkpoint import Model, build_networks, save_model
from erfsfm.cli import main
from erfsfm.config import NetworkConfig, dump_yaml, load_experiment
from erfsfm.model_record import ModelRecord

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
def refusal(command_line: Callable[..., tuple[int, str, str]]) -> Refusal:
    """The one line of error of ``erfsfm ARGUMENTS``; nothing on stdout, exit code 1."""

    def call(*arguments: object) -> str:
        code, out, err = command_line(main, "erfsfm", *arguments)
        lines = [line for line in err.splitlines() if line.startswith("erfsfm: ")]
        assert (code, out, len(lines)) == (1, "", 1), err
        assert err.rstrip().endswith(lines[0]), "the error is the last line"
        return lines[0]

    return call


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    config = NetworkConfig(depth_width=0.0625, pose_width=0.125, height=32, width=64)
    save_model(
        tmp_path / "weights",
        Model(ModelRecord(network=config, trained_on=[]), build_networks(config)),
    )
    return tmp_path / "weights"


def test_images_of_mixed_size(
    refusal: Refusal, tmp_path: Path, write_root: WriteRoot, weights: Path
) -> None:
    root = write_root(tmp_path / "root", frames=5, size=(64, 96))
    odd = root / "sequences/00/image_2/000002.png"
    cv2.imwrite(str(odd), np.zeros((48, 96, 3), np.uint8))
    wanted = "000002.png is 96 x 48"
    assert wanted in refusal(*TRAIN, *SMALL, "--dataset", root, "--output", tmp_path / "run")
    assert wanted in refusal(
        "evaluate", "pose", "--dataset", root, "--sequence", "00", "--weights", weights
    )


def test_truncated_image(
    refusal: Refusal, tmp_path: Path, write_root: WriteRoot, weights: Path
) -> None:
    root = write_root(tmp_path / "root", frames=5, suffix=".jpg")
    image = root / "sequences/00/image_2/000002.jpg"
    image.write_bytes(image.read_bytes()[: image.stat().st_size // 2])
    wanted = "000002.jpg is truncated"
    assert wanted in refusal(*TRAIN, *SMALL, "--dataset", root, "--output", tmp_path / "run")
    assert wanted in refusal("predict", image, "--weights", weights, "--output", tmp_path / "depth")
    assert wanted in refusal(
        "evaluate", "pose", "--dataset", root, "--sequence", "00", "--weights", weights
    )


@pytest.mark.parametrize("verb", ["predict", "export", "receptive-field"])
def test_weights_cut_in_half(refusal: Refusal, tmp_path: Path, weights: Path, verb: str) -> None:
    path = weights / "depth.safetensors"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((32, 64, 3), np.uint8))
    given = [tmp_path / "a.png"] if verb == "predict" else []
    output = {"predict": "depth", "export": "net.onnx", "receptive-field": "field.png"}[verb]
    error = refusal(verb, *given, "--weights", weights, "--output", tmp_path / output)
    assert "depth.safetensors is damaged" in error
    assert not (tmp_path / output).exists()


def insert_non_finite(path: Path, value: float) -> None:
    """Put a non-finite number into the first tensor of a weights file."""
    tensors = load_file(path)
    next(iter(tensors.values())).view(-1)[0] = value
    save_file(tensors, path)


@pytest.mark.parametrize(("kind", "value"), [("depth", float("nan")), ("pose", float("inf"))])
def test_weights_that_are_not_finite(
    refusal: Refusal, tmp_path: Path, write_root: WriteRoot, weights: Path, kind: str, value: float
) -> None:
    insert_non_finite(weights / f"{kind}.safetensors", value)
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


def test_an_output_with_other_peoples_files(refusal: Refusal, tmp_path: Path) -> None:
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
