import pytest
import torch

from erfsfm.config import ExperimentConfig, NetworkConfig, TeacherConfig, TrainingConfig
from erfsfm.networks.deformable import DeformableConv2d
from erfsfm.training.module import SelfSupervision


def test_offset_predictors_have_their_own_learning_rate():
    network = NetworkConfig(
        depth="erf-depthnet-dfcv2", pose="erf-posenet-dfc", depth_width=0.25, pose_width=0.25
    )
    module = SelfSupervision(
        ExperimentConfig(
            network=network, training=TrainingConfig(learning_rate=1e-3, offset_rate=0.1)
        )
    )
    optimiser = module.configure_optimizers()["optimizer"]
    rates = {id(p): group["lr"] for group in optimiser.param_groups for p in group["params"]}
    assert len(rates) == sum(1 for _ in module.parameters())
    layers = [layer for layer in module.modules() if isinstance(layer, DeformableConv2d)]
    assert layers
    for layer in layers:
        assert (
            rates[id(layer.offset.weight)] == rates[id(layer.modulator.bias)] == pytest.approx(1e-4)
        )
        assert rates[id(layer.kernel.weight)] == 1e-3


def test_an_untrained_pose_network_keeps_its_weights_and_norm_statistics():
    network = NetworkConfig(
        depth="depthnet",
        pose="posenet",
        depth_width=0.0625,
        pose_width=0.125,
        normalisation="batch",
        sources=2,
    )
    module = SelfSupervision(
        ExperimentConfig(network=network, training=TrainingConfig(networks="depth"))
    )
    before = {name: value.clone() for name, value in module.state_dict().items()}
    module.train()
    assert module.depth_net.training and not module.pose_net.training
    K = torch.tensor([[40.0, 0, 32], [0, 40, 16], [0, 0, 1]]).expand(2, 3, 3)
    batch = {"target": torch.rand(2, 3, 32, 64), "sources": torch.rand(2, 2, 3, 32, 64), "K": K}
    optimiser = module.configure_optimizers()["optimizer"]
    module.log = module.log_dict = lambda *_, **__: None
    module._trainer = None
    module.training_step(batch, 0).backward()
    optimiser.step()
    changed = {
        name.split(".")[0]
        for name, value in module.state_dict().items()
        if not torch.equal(value, before[name])
    }
    assert changed == {"depth_net"}


@pytest.mark.parametrize("networks", ["depth", "pose", "both"])
def test_validation_runs_no_network_that_was_never_trained(networks):
    network = NetworkConfig(
        depth="depthnet", pose="posenet", depth_width=0.0625, pose_width=0.125, sources=2
    )
    training, teacher = (
        TrainingConfig(networks=networks),
        TeacherConfig(views="many", rotation_weight=1.0),
    )
    module = SelfSupervision(
        ExperimentConfig(network=network, training=training, teacher=teacher)
    ).eval()
    ran = []
    for kind in ("depth", "pose"):
        module.network(kind).register_forward_hook(lambda *_, kind=kind: ran.append(kind))
    K = torch.tensor([[[40.0, 0, 32], [0, 40, 16], [0, 0, 1]]])
    with torch.no_grad():
        module.validation_step(
            {"target": torch.rand(1, 3, 32, 64), "sources": torch.rand(1, 2, 3, 32, 64), "K": K}, 0
        )
    assert ran == (["depth", "pose"] if networks == "both" else [networks])
