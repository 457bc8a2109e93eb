"""Configurations: reading, overrides and error messages."""

from __future__ import annotations

from pathlib import Path

import pytest

from erfsfm.config import ExperimentConfig, dump_yaml, load_experiment

SHIPPED = sorted((Path(__file__).parents[2] / "configs" / "erfsfm").glob("*.yaml"))


def write(folder: Path, text: str) -> Path:
    path = folder / "experiment.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_configurations_load_by_name_and_by_path(path: Path) -> None:
    assert load_experiment(path.stem) == load_experiment(path)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_round_trip(path: Path, tmp_path: Path) -> None:
    config = load_experiment(path, ["data.roots=[/a/b, c]", "initial_weights=sim"])
    assert load_experiment(write(tmp_path, dump_yaml(config))) == config


def test_defaults_are_the_papers() -> None:
    config = load_experiment(None)
    assert config == ExperimentConfig()
    assert config.network.sources == 4
    assert (config.network.height, config.network.width) == (128, 416)
    assert config.loss.smoothness_weight == 0.2
    assert config.loss.ssim_weight == 0
    assert config.training.learning_rate == 2e-4
    assert load_experiment(None).network.normalisation == "none"


def test_overrides() -> None:
    config = load_experiment("tiny", ["training.steps=7", "data.validation=[]", "loss.auto_mask=false"])
    assert (config.training.steps, config.data.validation, config.loss.auto_mask) == (7, [], False)
    assert config.network == load_experiment("tiny").network
