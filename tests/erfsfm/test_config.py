"""Configurations: reading, overrides and error messages."""

from __future__ import annotations

from pathlib import Path

import pytest

from erfsfm.common.errors import ConfigError
from erfsfm.config import ExperimentConfig, config_folders, dump_yaml, load_experiment

SHIPPED = sorted((Path(__file__).parents[2] / "configs" / "erfsfm").glob("*.yaml"))


def refusal(path: str | Path | None, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_experiment(path, list(overrides))
    assert "\n" not in str(caught.value)
    return str(caught.value)


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
    assert config.loss.ssim_weight == config.loss.mask_weight == 0
    assert config.training.learning_rate == 2e-4
    assert load_experiment(None).network.normalisation == "none"


@pytest.mark.parametrize("text", ["1e-4", "1.0e-4", "0.0001"])
def test_small_numbers_in_any_spelling(tmp_path: Path, text: str) -> None:
    """PyYAML reads 1e-4 as text."""
    path = write(tmp_path, f"training: {{learning_rate: {text}}}")
    assert load_experiment(path).training.learning_rate == 1e-4
    assert load_experiment(None, [f"training.learning_rate={text}"]).training.learning_rate == 1e-4


def test_overrides() -> None:
    config = load_experiment("tiny", ["training.steps=7", "data.validation=[]", "loss.auto_mask=false"])
    assert (config.training.steps, config.data.validation, config.loss.auto_mask) == (7, [], False)
    assert config.network == load_experiment("tiny").network


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("training.stepz=3", "did you mean 'training.steps'"),
        ("network.zzz=3", "known keys of network: depth, pose"),
        ("training.steps=0", "greater than or equal to 1; got 0"),
        ("network.sources=3", "2 or 4"),
        ("loss.mask_weight=0.2", "network.masks"),
        ("network.masks=true", "needs a loss.mask_weight above 0"),
        ("data.weights={simulated: -1}", "data.weights"),
        ("training=3", "'training'"),
        ("training.steps", "section.key=value"),
        ("=3", "section.key=value"),
        ("training.steps.deep=3", "not a section"),
        ("data.roots=[a", "not YAML"),
    ],
)
def test_bad_overrides(override: str, words: str) -> None:
    if override == "training.steps.deep=3":
        assert words in refusal(None, "training.steps=3", override)
    else:
        assert words in refusal(None, override)


def test_unknown_names_list_the_known() -> None:
    message = refusal("tinny")
    assert "'tinny'" in message
    assert "tiny" in message.replace("tinny", "")
    assert "sim" in message


def test_named_configurations_are_looked_up_in_the_wheel_and_in_the_tree() -> None:
    package = Path(__file__).parents[2] / "erfsfm"
    assert config_folders() == [package / "_configs", package.parent / "configs" / "erfsfm"]
