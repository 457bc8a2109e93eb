"""A prepared folder trains in place of the data that it was made from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from typer.testing import CliRunner

from erfsfm.checkpoint import load_model
from erfsfm.cli import app
from erfsfm.common.errors import ConfigError, DataError, TrainingError
from erfsfm.config import ExperimentConfig
from erfsfm.data.discovery import discover
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.data.snippets import SnippetDraws, ValidationSnippets
from erfsfm.data.split import split_recordings
from erfsfm.training.run import prepare, train, trained_on

Small = dict[str, dict[str, Any]]
SIZE, STRIDE = (32, 64), 3


@pytest.fixture
def roots(tmp_path: Path, write_root: Callable[..., Path]) -> list[Path]:
    """Twelve real frames, and a world to validate on."""
    real = write_root(tmp_path / "kitti", frames=12, step=(0.0, 0.0, 0.05))
    return [real, write_root(tmp_path / "held_out", frames=9, seed=500, depth=True)]


@pytest.fixture
def config(
    small: Small, roots: list[Path], measure: Callable[..., None], tmp_path: Path
) -> ExperimentConfig:
    """Of a training by many views, measured already."""
    data = {"roots": roots, "validation": ["simulated/500"], "exclude": []}
    teacher = {
        "views": "many",
        "stride": STRIDE,
        "structure_weight": 1.0,
        "translation_weight": 1.0,
    }
    tree = small | {
        "data": small["data"]
        | data
        | {"ranges": {"kitti_odometry/00": "2:11"}, "flip": 0.0, "zoom": 1.0},
        "teacher": teacher | {"cache": tmp_path / "measured"},
        "loss": {"photometric_weight": 0.0},
    }
    config = ExperimentConfig.model_validate(tree)
    measure(config, lambda recording, target: (1 + recording.start + target) / 100)
    return config


def changed(config: ExperimentConfig, **data: Any) -> ExperimentConfig:
    return config.model_copy(update={"data": config.data.model_copy(update=data)})


def draws(config: ExperimentConfig, folder: Path) -> SnippetDraws:
    return SnippetDraws(
        split_recordings(config.data)[0],
        config,
        40,
        many_views=ManyViewTeacher(folder, SIZE, STRIDE),
    )


def test_it_has_the_same_samples(config, tmp_path):
    prepare(config, tmp_path / "prepared")
    elsewhere = changed(config, roots=[tmp_path / "prepared"])
    original, again = draws(config, tmp_path / "measured"), draws(elsewhere, tmp_path / "nowhere")
    for number in range(6):
        one, other = original.draw(number), again.draw(number)
        assert (one["sources"].float() - other["sources"].float()).abs().mean() < 6, (
            "levels of 255, by JPEG"
        )
        torch.testing.assert_close(other["least"], one["least"], rtol=0.03, atol=0)
        torch.testing.assert_close(other["T_source_target"], one["T_source_target"])
        torch.testing.assert_close(other["K"], one["K"])
    train(elsewhere, tmp_path / "run", device="cpu")
    assert load_model(tmp_path / "run").record.trained_on == ["kitti_odometry/00[2:11]"]


def test_a_part_of_it_has_its_own_labels(config, tmp_path):
    prepare(config, tmp_path / "prepared")
    part = changed(config, roots=[tmp_path / "prepared"], ranges={"kitti_odometry/00": "4:11"})
    drive = draws(part, tmp_path / "nowhere")
    (recording,) = drive.recordings
    teacher = ManyViewTeacher(tmp_path / "nowhere", SIZE, STRIDE)
    for target in teacher.drive(recording).targets(sources=2):
        least, _ = teacher.drive(recording).label(target)
        assert float(least.mean()) == pytest.approx((1 + recording.start + target) / 100, rel=0.03)
    assert {recording.start + t for t in teacher.drive(recording).targets(sources=2)} == {5, 8}


def test_validation_is_on_the_same_snippets_with_their_truth(config, tmp_path):
    prepare(config, tmp_path / "prepared")
    _, held_out = split_recordings(config.data)
    _, copied = split_recordings(changed(config, roots=[tmp_path / "prepared"]).data)
    original, again = ValidationSnippets(held_out, config), ValidationSnippets(copied, config)
    assert len(original) == len(again) == 7
    for one, other in zip(original, again):
        assert one.keys() == other.keys() >= {"depth", "T_source_target"}
        torch.testing.assert_close(other["T_source_target"], one["T_source_target"])
        assert torch.equal(other["depth"], one["depth"])


def test_images_that_cannot_be_read_are_left_out(config, roots, small, tmp_path, caplog):
    (roots[0] / "sequences/00/image_2/000005.png").write_bytes(b"no image")
    tree = small | {"data": small["data"] | {"roots": roots[:1], "exclude": []}}
    config = ExperimentConfig.model_validate(tree)
    prepare(config, tmp_path / "prepared")
    assert "1 of 12 images" in caplog.text and "000005.png" in caplog.text
    train(changed(config, roots=[tmp_path / "prepared"]), tmp_path / "run", device="cpu")


def test_what_is_there_is_never_overwritten(config, tmp_path):
    (tmp_path / "prepared").mkdir()
    (tmp_path / "prepared" / "thesis.txt").touch()
    with pytest.raises(ConfigError, match="not empty"):
        prepare(config, tmp_path / "prepared")
    assert [path.name for path in (tmp_path / "prepared").iterdir()] == ["thesis.txt"]


def test_one_that_fails_leaves_nothing(config, roots, tmp_path):
    before = sorted(tmp_path.iterdir())
    for image in sorted(roots[1].rglob("depth_2/*.png")):
        image.write_bytes(b"no depth")
    with pytest.raises(DataError):
        prepare(config, tmp_path / "prepared")
    assert sorted(tmp_path.iterdir()) == before


def test_labels_of_another_teacher_are_asked_for(config, tmp_path):
    prepare(config, tmp_path / "prepared")
    finer = config.model_copy(update={"teacher": config.teacher.model_copy(update={"stride": 1})})
    with pytest.raises(TrainingError, match="prepare the data again"):
        train(changed(finer, roots=[tmp_path / "prepared"]), tmp_path / "run", device="cpu")


def test_stops_stay_out(small, write_raw, tmp_path):
    drive = write_raw(
        tmp_path / "raw", drive="2011_10_03_drive_0099", speeds=[5] * 6 + [0] * 3 + [5] * 6
    )
    tree = small | {"data": small["data"] | {"roots": [drive], "exclude": []}}
    config = ExperimentConfig.model_validate(tree)
    prepare(config, tmp_path / "prepared")
    names = [recording.frames_name for recording in discover(tmp_path / "prepared")]
    assert names == [
        f"kitti_raw/2011_10_03_drive_0099{frames}" for frames in ("[0:6]", "[9:15]") * 2
    ]
    assert trained_on(split_recordings(changed(config, roots=[tmp_path / "prepared"]).data)[0]) == [
        "kitti_raw/2011_10_03_drive_0099[0:6]",
        "kitti_raw/2011_10_03_drive_0099[9:15]",
    ]


def test_the_command_says_how_to_go_on(write_root, tmp_path):
    world = write_root(tmp_path / "world", frames=8, seed=3)
    size = ["--set", "network.height=32", "--set", "network.width=64", "--set", "training.steps=2"]
    command = [
        "train",
        "--config",
        "tiny",
        "--dataset",
        str(world),
        "--prepare",
        str(tmp_path / "prepared"),
    ]
    result = CliRunner().invoke(app, [*command, *size], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    told = " ".join(result.output.split()).partition("train with: erfsfm ")[2].split()
    result = CliRunner().invoke(
        app, [*told, *size, "--output", str(tmp_path / "run")], catch_exceptions=False
    )
    assert result.exit_code == 0, result.output
    assert load_model(tmp_path / "run").record.trained_on == ["simulated/3"]
