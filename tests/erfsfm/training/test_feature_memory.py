"""Features that are kept give the same poses, and each image is encoded once."""

import pytest
import torch

from erfsfm.config import ExperimentConfig
from erfsfm.networks.presets import build
from erfsfm.training.feature_memory import FeatureMemory, features_recur


@pytest.fixture
def network():
    torch.manual_seed(0)
    return build("posenet-lite0", sources=2).train()


@pytest.mark.parametrize("megabytes", [0, 10])
def test_the_motion_is_of_the_features_of_the_images(network, megabytes, monkeypatch):
    images = torch.rand(4, 3, 64, 96, generator=torch.Generator().manual_seed(1)) * 2 - 1
    frames = torch.tensor([[7, 8, 9], [8, 9, 10]])
    seen = images[frames - 7]  # (2, 3, 3, H, W)
    target, sources = seen[:, 1], [seen[:, 0], seen[:, 2]]
    features = network.features
    wanted = [features(image).detach() for image in (target, *sources)]
    encoded = []
    monkeypatch.setattr(network, "features", lambda each: encoded.append(len(each)) or features(each))
    monkeypatch.setattr(network, "motion", lambda of_target, of_sources: [of_target, *of_sources])
    memory = FeatureMemory(network, megabytes)
    for _ in range(2):
        for got, want in zip(memory.poses(target, sources, frames), wanted, strict=True):
            torch.testing.assert_close(got.float(), want, atol=1e-3, rtol=1e-3)
    assert sum(encoded) == (4 if megabytes else 12)


def test_images_that_change_are_not_remembered():
    training = {"networks": "pose", "frozen_stages": 6}
    tree = {"data": {"colour_jitter": 0.0, "zoom": 1.0}, "teacher": {"views": "many"}, "training": training}
    assert features_recur(ExperimentConfig.model_validate(tree))
    for section, key, value in (
        ("data", "colour_jitter", 0.1),
        ("data", "zoom", 1.2),
        ("data", "weather", 0.5),
        ("training", "frozen_stages", 5),
        ("training", "networks", "both"),
    ):
        other = {name: dict(values) for name, values in tree.items()}
        other[section][key] = value
        assert not features_recur(ExperimentConfig.model_validate(other)), (section, key)
