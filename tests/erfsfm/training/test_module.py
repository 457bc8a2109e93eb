import pytest

from erfsfm.config import ExperimentConfig, NetworkConfig, TrainingConfig
from erfsfm.networks.deformable import DeformableConv2d
from erfsfm.training.module import SelfSupervision


def test_what_predicts_offsets_learns_at_its_own_rate():
    network = NetworkConfig(depth="erf-depthnet-dfcv2", pose="erf-posenet-dfc", depth_width=0.25, pose_width=0.25)
    module = SelfSupervision(
        ExperimentConfig(network=network, training=TrainingConfig(learning_rate=1e-3, offset_rate=0.1))
    )
    optimiser = module.configure_optimizers()["optimizer"]
    rates = {id(p): group["lr"] for group in optimiser.param_groups for p in group["params"]}
    assert len(rates) == sum(1 for _ in module.parameters())
    layers = [layer for layer in module.modules() if isinstance(layer, DeformableConv2d)]
    assert layers
    for layer in layers:
        assert rates[id(layer.offset.weight)] == rates[id(layer.modulator.bias)] == pytest.approx(1e-4)
        assert rates[id(layer.kernel.weight)] == 1e-3
