"""Features that are kept give the same poses, and each image is encoded once."""

import numpy as np
import pytest
import torch

from erfsfm.checkpoint import load_model
from erfsfm.config import ExperimentConfig
from erfsfm.data.many_view_teacher import ManyViewTeacher
from erfsfm.data.snippets import split_recordings
from erfsfm.networks.lite0_pose import Lite0PoseNet
from erfsfm.networks.presets import build
from erfsfm.training.feature_memory import FeatureMemory, features_recur
from erfsfm.training.run import train


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


def test_a_training_of_poses_encodes_each_image_once_and_wants_no_label(small, write_root, tmp_path, monkeypatch):
    root = write_root(tmp_path / "kitti", frames=8, step=(0.0, 0.0, 0.05))
    network = {"pose": "posenet-lite0", "height": 32, "width": 64, "sources": 4}
    tree = small | {
        "network": small.get("network", {}) | network,
        "data": small["data"] | {"roots": [root], "validation": [], "exclude": [], "zoom": 1.0, "colour_jitter": 0.0},
        "teacher": {"views": "many", "rotation_weight": 10.0, "translation_weight": 1.0, "cache": tmp_path / "poses"},
        "loss": {"photometric_weight": 0.0, "smoothness_weight": 0.0},
        "training": small["training"] | {"networks": "pose", "frozen_stages": 6, "steps": 12},
        "pretrained": "none",
    }
    config = ExperimentConfig.model_validate(tree)
    (recording,) = split_recordings(config.data)[0]
    T_world_camera = np.tile(np.eye(4), (len(recording), 1, 1))
    T_world_camera[:, 2, 3] = 0.3 * np.arange(len(recording))
    ManyViewTeacher(tmp_path / "poses", (32, 64), 2).drive(recording).keep_poses(T_world_camera)
    encoded = []
    features = Lite0PoseNet.features
    monkeypatch.setattr(Lite0PoseNet, "features", lambda self, each: encoded.append(len(each)) or features(self, each))
    output = train(config, tmp_path / "run", device="cpu")
    assert 0 < sum(encoded) <= 2 * len(recording)  # as they are and mirrored
    assert load_model(output).record.network.pose == "posenet-lite0"
    assert not list((tmp_path / "poses").rglob("*.npz"))
