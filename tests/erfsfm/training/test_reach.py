"""A step of every shipped configuration on the device `meta`: nothing waits for the device, no devices are mixed."""

from __future__ import annotations

from typing import Any

import pytest

from erfsfm.config import ExperimentConfig, load_experiment
from erfsfm.training.reach import without_gradient


def test_a_step_of_every_configuration_reaches_every_weight(configuration: str) -> None:
    assert without_gradient(load_experiment(configuration)) == []


@pytest.mark.parametrize(
    "sections",
    [
        {"teacher": {"views": "many", "structure_weight": 1.0}},  # measured motion warps the images
        {"teacher": {"structure_weight": 1.0, "alone_steps": 5}},  # in the first steps
    ],
)
def test_a_network_that_no_term_needs_is_not_reached(sections: dict[str, Any]) -> None:
    network = {"depth_width": 0.0625, "pose_width": 0.125, "height": 32, "width": 64}
    config = ExperimentConfig.model_validate({"network": network, **sections})
    assert {name.partition(".")[0] for name in without_gradient(config)} == {"pose_net"}


def test_weather_and_exact_depth_are_of_the_step() -> None:
    network = {"depth_width": 0.0625, "pose_width": 0.125, "height": 32, "width": 64}
    teacher = {"views": "many", "structure_weight": 1.0, "rotation_weight": 1.0}
    tree = {"network": network, "teacher": teacher, "data": {"exact": 0.5, "weather": 0.5}}
    assert without_gradient(ExperimentConfig.model_validate(tree)) == []
