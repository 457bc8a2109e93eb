"""Configurations: reading, overrides and error messages."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from erfsfm.common.errors import ConfigError
from erfsfm.config import ExperimentConfig, NetworkConfig, config_folders, dump_yaml, load_experiment

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


def test_there_are_shipped_configurations() -> None:
    assert {"tiny", "sim"} <= {path.stem for path in SHIPPED}


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


def test_an_empty_file_is_the_defaults(tmp_path: Path) -> None:
    assert load_experiment(write(tmp_path, "")) == ExperimentConfig()


@pytest.mark.parametrize("text", ["1e-4", "1.0e-4", "0.0001"])
def test_small_numbers_in_any_spelling(tmp_path: Path, text: str) -> None:
    """PyYAML reads 1e-4 as text."""
    path = write(tmp_path, f"training: {{learning_rate: {text}}}")
    assert load_experiment(path).training.learning_rate == 1e-4
    assert load_experiment(None, [f"training.learning_rate={text}"]).training.learning_rate == 1e-4


def test_configurations_are_frozen() -> None:
    config = ExperimentConfig()
    with pytest.raises(ValidationError):
        config.training.steps = 3  # type: ignore[misc]


def test_overrides() -> None:
    config = load_experiment("tiny", ["training.steps=7", "data.validation=[]", "loss.auto_mask=false"])
    assert (config.training.steps, config.data.validation, config.loss.auto_mask) == (7, [], False)
    assert config.network == load_experiment("tiny").network


def test_overrides_reach_into_dictionaries() -> None:
    config = load_experiment(None, ["data.ranges.kitti_odometry/00=0:250", "data.weights={simulated: 2}"])
    assert config.data.ranges == {"kitti_odometry/00": "0:250"}
    assert config.data.weights == {"simulated": 2}


def test_the_last_override_counts() -> None:
    assert load_experiment(None, ["training.steps=7", "training.steps=8"]).training.steps == 8


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("training.stepz=3", "did you mean 'training.steps'"),
        ("trainning.steps=3", "did you mean 'training'"),
        ("network.zzz=3", "known keys of network: depth, pose"),
        ("training.steps=0", "greater than or equal to 1; got 0"),
        ("training.steps=many", "got 'many'"),
        ("training.learning_rate=-1", "greater than 0"),
        ("network.sources=3", "2 or 4"),
        ("network.alignment=flow", "'none' or 'images'"),
        ("network.fidelity=exact", "'default' or 'paper'"),
        ("network.height=0", "network.height"),
        ("loss.reduction=median", "loss.reduction"),
        ("loss.mask_weight=0.2", "network.masks"),
        ("network.masks=true", "needs a loss.mask_weight above 0"),
        ("data.weights={simulated: -1}", "data.weights"),
        ("training.seed=-1", "training.seed"),
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


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("training: {stepz: 3}", "did you mean 'training.steps'"),
        ("training: [1]", "training"),
        ("- 1", "sections"),
        ("words", "sections"),
        ("a: [", "not YAML"),
        ("a: b: c", "not YAML"),
        ("training: {precision: 64}", "training.precision"),
        ("loss: {mask_weight: 1}", "network.masks"),
        ("network: {alignment: images, height: 100}", "multiples of 32; got 100 and 416"),
    ],
)
def test_bad_files(tmp_path: Path, text: str, words: str) -> None:
    path = write(tmp_path, text)
    message = refusal(path)
    assert words in message
    assert str(path) in message


def test_a_binary_file_is_not_yaml(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes(bytes(range(256)))
    assert "not YAML" in refusal(path)


def test_unknown_names_list_the_known() -> None:
    message = refusal("tinny")
    assert "'tinny'" in message
    assert "tiny" in message.replace("tinny", "")
    assert "sim" in message


def test_named_configurations_are_looked_up_in_the_wheel_and_in_the_tree() -> None:
    package = Path(__file__).parents[2] / "erfsfm"
    assert config_folders() == [package / "_configs", package.parent / "configs" / "erfsfm"]


def test_dump_is_readable() -> None:
    text = dump_yaml(NetworkConfig())
    assert text.startswith("depth: depthnet\npose: posenet\n")
    assert "!!" not in text
