"""The trainings behind the rows of the paper's Tables 1 to 3, at the paper's resolutions."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from erfsfm.common.errors import ConfigError
from erfsfm.config import load_experiment

FILES = sorted((Path(__file__).parents[2] / "configs" / "erfsfm").glob("table*.yaml"))


def test_the_guide_names_them_all() -> None:
    guide = (FILES[0].parents[2] / "docs" / "design" / "reproduction.md").read_text()
    assert set(re.findall(r"^\| `(table[123]-.+?)`", guide, re.MULTILINE)) == {path.stem for path in FILES}


def test_the_beginning_of_a_name_lists_all_that_begin_so() -> None:
    with pytest.raises(ConfigError) as caught:
        load_experiment("table1")
    assert all((path.stem in str(caught.value)) == path.stem.startswith("table1") for path in FILES)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_has_the_experiment_of_its_name(path: Path) -> None:
    experiment = load_experiment(path)
    network = experiment.network
    networks, size = re.fullmatch(r"table[123]-(.*?)-(\d+x\d+)", path.stem).groups()  # type: ignore[union-attr]
    assert f"{network.width}x{network.height}" == size
    presets = networks if "depthnet" in networks else f"depthnet-{networks}"
    presets = presets if "posenet" in presets else f"{presets}-posenet"
    assert f"{network.depth}-{network.pose}" == presets
    assert (network.fidelity, network.sources, network.normalisation) == ("paper", 4, "none")
    assert (network.depth_width, network.pose_width) == (1.0, 1.0)
    loss, training, data = experiment.loss, experiment.training, experiment.data
    assert (loss.smoothness, loss.smoothness_weight) == ("depth-second-order", 0.2)
    assert (loss.ssim_weight, loss.reduction, loss.auto_mask) == (0, "mean", False)
    assert (training.batch, training.learning_rate, training.schedule, training.steps) == (4, 2e-4, "constant", 200_000)
    assert (data.flip, data.zoom, data.colour_jitter) == (0.5, 1.15, 0)
    assert {"kitti_odometry/09", "kitti_odometry/10"} == set(data.exclude)
