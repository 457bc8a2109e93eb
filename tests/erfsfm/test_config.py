"""Every shipped training configuration starts: its weights to start from, its data and its first step fit together."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from erfsfm.checkpoint import load_model
from erfsfm.cli import main
from erfsfm.common.errors import ConfigError
from erfsfm.config import UNTRAINED, ExperimentConfig, dump_yaml, load_experiment
from erfsfm.model_record import SHIPPED
from slam.simulation.options import SimulationOptions
from slam.simulation.recording import write_kitti_root
from slam.simulation.street import SimulatedStreet

FRAMES = 12
SEQUENCES = ("00", "02", "05", "06")


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("shared")


@pytest.fixture
def data(shared: Path, write_root: Callable[..., Path]) -> list[Path]:
    """Tiny drives of every kind that a configuration names."""
    roots = [shared / name for name in ("world", "held_out", "kitti", "folder")]
    if not shared.joinpath("world").exists():
        write_kitti_root(
            SimulatedStreet(SimulationOptions("straight", FRAMES, 0, 96, 64)), roots[0], depth=True
        )
        write_root(roots[1], FRAMES, seed=500)
        write_root(roots[2], FRAMES, SEQUENCES)
        roots[3].mkdir()
        for index in range(FRAMES):
            noise = np.random.default_rng(index).integers(0, 256, (64, 96, 3), np.uint8)
            cv2.imwrite(str(roots[3] / f"{index:06d}.png"), noise)
        camera = "{width: 96, height: 64, fx: 60, fy: 62, cx: 47, cy: 30, fps: 10}"
        (roots[3] / "camera.yaml").write_text(camera)
    return roots


def test_weights_have_the_name_of_the_configuration_that_trains_them():
    for path in SHIPPED.glob("*/model.yaml"):
        record = load_model(path.parent.name).record
        assert record.network == load_experiment(path.parent.name).network
        assert record.trained_on and record.licence


def test_it_starts(
    configuration: str,
    data: list[Path],
    measure: Callable[..., None],
    command_line: Callable[..., Any],
    tmp_path: Path,
):
    written = load_experiment(configuration)
    words = "training.batch=2 training.steps=1 data.workers=0 data.cache_mb=50"
    words += f" data.validation=[simulated/500] teacher.cache={tmp_path / 'measured'}"
    small = [*words.split(), "data.validation_share=0"]
    if written.initial_weights in UNTRAINED:  # those fit one size and width
        small += ["network.depth_width=0.0625", "network.pose_width=0.125"]
        paper = written.network.fidelity == "paper"  # its maps shrink
        height, width = (128, 192) if paper else (96, 160)
        small += [f"network.height={height}", f"network.width={width}"]
    if "lite0" in written.network.depth:
        small += ["network.depth_width=1"]
    config = load_experiment(configuration, small).with_roots(data)
    if config.teacher.views == "many":
        measure(config, lambda *_: 0.25)
    worlds = data[:2] if config.teacher.exact else data
    options = [word for root in worlds for word in ("--dataset", str(root))]
    options += [word for change in small for word in ("--set", change)]
    output = str(tmp_path / "run")
    options += ["--output", output, "--device", "cpu"]
    command = command_line(main, "erfsfm", "train", "--config", configuration, *options)
    assert command[0] == 0 and f"--weights {output}" in command[1], command
    record = load_model(output).record
    assert record.step == 1
    assert record.network == config.network


FILES = sorted((Path(__file__).parents[2] / "configs" / "erfsfm").glob("table*.yaml"))


def test_the_guide_names_them_all():
    guide = (FILES[0].parents[2] / "docs" / "design" / "reproduction.md").read_text()
    assert set(re.findall(r"^\| `(table[123]-.+?)`", guide, re.MULTILINE)) == {
        path.stem for path in FILES
    }


def test_the_beginning_of_a_name_lists_all_that_begin_so():
    with pytest.raises(ConfigError) as caught:
        load_experiment("table1")
    assert all((path.stem in str(caught.value)) == path.stem.startswith("table1") for path in FILES)


def test_a_file_has_the_experiment_of_its_name():
    for path in FILES:
        experiment = load_experiment(path)
        network, loss, training, data = (
            experiment.network,
            experiment.loss,
            experiment.training,
            experiment.data,
        )
        networks, size = re.fullmatch(r"table[123]-(.*?)-(\d+x\d+)", path.stem).groups()  # type: ignore[union-attr]
        assert f"{network.width}x{network.height}" == size
        presets = networks if "depthnet" in networks else f"depthnet-{networks}"
        presets = presets if "posenet" in presets else f"{presets}-posenet"
        assert f"{network.depth}-{network.pose}" == presets
        assert (network.fidelity, network.sources, network.normalisation) == ("paper", 4, "none")
        assert (network.depth_width, network.pose_width) == (1.0, 1.0)
        assert (loss.smoothness, loss.smoothness_weight) == ("depth-second-order", 0.2)
        assert (loss.ssim_weight, loss.reduction) == (0, "mean")
        assert (training.batch, training.learning_rate) == (4, 2e-4)
        assert (training.schedule, training.steps) == ("constant", 200_000)
        assert (data.flip, data.zoom, data.colour_jitter) == (0.5, 1.15, 0)
        assert {"kitti_odometry/09", "kitti_odometry/10", "eigen"} == set(data.exclude)


def test_round_trip(tmp_path: Path):
    for path in FILES[0].parent.glob("*.yaml"):
        config = load_experiment(path, ["data.roots=[/a/b, c]", "initial_weights=sim"])
        (tmp_path / "experiment.yaml").write_text(dump_yaml(config))
        assert load_experiment(tmp_path / "experiment.yaml") == config


def test_defaults_are_the_papers():
    config = load_experiment(None)
    assert config == ExperimentConfig()
    assert config.network.sources == 4
    assert (config.network.height, config.network.width) == (128, 416)
    assert config.loss.smoothness_weight == 0.2
    assert config.loss.ssim_weight == 0
    assert config.training.learning_rate == 2e-4
    assert config.network.normalisation == "none"
