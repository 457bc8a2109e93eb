"""Every shipped training configuration starts: its weights to start from, its data and its first step fit together."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from erfsfm.checkpoint import load_model
from erfsfm.cli import main
from erfsfm.config import load_experiment
from erfsfm.model_record import SHIPPED
from slam.simulation.kitti_layout import write_kitti_root
from slam.simulation.options import SimulationOptions
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
        write_kitti_root(SimulatedStreet(SimulationOptions("straight", FRAMES, 0, 96, 64)), roots[0], depth=True)
        write_root(roots[1], FRAMES, seed=500)
        write_root(roots[2], FRAMES, SEQUENCES)
        roots[3].mkdir()
        for index in range(FRAMES):
            cv2.imwrite(str(roots[3] / f"{index:06d}.png"), np.full((64, 96, 3), 10 * index, np.uint8))
        camera = {"width": 96, "height": 64, "fx": 60.0, "fy": 62.0, "cx": 47.0, "cy": 30.0, "fps": 10}
        (roots[3] / "camera.yaml").write_text(yaml.safe_dump(camera))
    return roots


@pytest.mark.parametrize("weights", sorted(path.parent.name for path in SHIPPED.glob("*/model.yaml")))
def test_weights_have_the_name_of_the_configuration_that_trains_them(weights: str) -> None:
    assert load_model(weights).record.network == load_experiment(weights).network


def test_it_starts(
    configuration: str, data: list[Path], measure: Callable[..., None], command_line: Callable[..., Any], tmp_path: Path
) -> None:
    written = load_experiment(configuration)
    small = ["training.batch=2", "training.steps=1", "data.workers=0", "data.validation=[simulated/500]"]
    small += ["data.validation_share=0", "data.validation_snippets=1", "data.cache_mb=50", "data.static_frames=keep"]
    small += [f"teacher.cache={tmp_path / 'measured'}"]
    if written.initial_weights is None:  # those fit one size and width
        small += ["network.height=96", "network.width=160", "network.depth_width=0.0625", "network.pose_width=0.125"]
        small += [] if written.network.fidelity == "default" else ["network.height=128", "network.width=192"]
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
