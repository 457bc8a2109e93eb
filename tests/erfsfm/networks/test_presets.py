import pytest
import torch

from erfsfm.networks.presets import build


def count(name, **options):
    with torch.device("meta"):
        return sum(parameter.numel() for parameter in build(name, **options).parameters())


@pytest.mark.parametrize(
    "name, wanted",
    [
        ("depthnet", 31_596_900),
        ("erf-depthnet-dilated", 31_596_900),
        ("erf-depthnet-dfc", 32_168_565),
        ("erf-depthnet-dfcv2", 32_371_132),
    ],
)
def test_depth_parameters(name, wanted):
    for fidelity in ("default", "paper"):
        assert count(name, fidelity=fidelity) == wanted


@pytest.mark.parametrize(
    "name, four, two",
    [
        ("posenet", 1_598_456, 1_590_668),
        ("erf-posenet-dilated", 1_598_456, 1_590_668),
        ("erf-posenet-dfc", 1_776_479, 1_768_691),
        ("erf-posenet-dfcv2", 1_759_865, 1_708_859),
    ],
)
def test_pose_parameters(name, four, two):
    for fidelity in ("default", "paper"):
        assert count(name, fidelity=fidelity) == four
        assert count(name, fidelity=fidelity, sources=2) == two


def test_fidelity_decides_where_offsets_start():
    for fidelity, neutral in [("default", True), ("paper", False)]:
        state = build("erf-posenet-dfc", fidelity=fidelity, width=0.25).state_dict()
        weights = [
            value
            for name, value in state.items()
            if name.endswith(("offset.weight", "modulator.weight"))
        ]
        assert len(weights) == 10
        assert all((not value.any()) == neutral for value in weights)


def test_width_scales_hidden_channels_and_not_the_heads():
    depth = build("depthnet", width=0.25)
    assert depth.encoder.stages[0][0][0].weight.shape == (8, 3, 7, 7)
    assert [head.out_channels for head in depth.heads] == [1] * 4
    pose = build("posenet", width=0.25, sources=3)
    assert pose.encoder.stages[0][0][0].weight.shape == (4, 12, 7, 7)
    assert pose.pose_head.weight.shape == (18, 64, 1, 1)
