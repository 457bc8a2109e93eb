"""Weights transferred from one variant of a network to another."""

import pytest
import torch

from erfsfm.checkpoint import take_over
from erfsfm.common.errors import ConfigError
from erfsfm.networks.presets import build


def made(name: str, width: float = 0.25, seed: int = 0) -> torch.nn.Module:
    torch.manual_seed(seed)
    return build(name, width=width, normalisation="batch").eval()


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("erf-depthnet-dfcv2", "erf-depthnet-dfc"),
        ("depthnet", "erf-depthnet-dfc"),
        ("posenet", "erf-posenet-dfcv2"),
        ("erf-posenet-dfc", "posenet"),
    ],
)
def test_a_network_with_zero_offsets_has_the_same_output_in_another_variant(first: str, second: str):
    trained, fresh = made(first), made(second, seed=1)
    for key, value in trained.named_parameters():
        if key.endswith(".bias"):
            torch.nn.init.zeros_(value)  # a deformable kernel has none
    take_over(fresh, trained.state_dict())
    image = torch.rand(1, 3, 64, 96)
    seen = (image,) if "depth" in first else (image, [image.flip(3), image.flip(2), image, image * 0.5])
    torch.testing.assert_close(fresh(*seen), trained(*seen), rtol=1e-4, atol=1e-5)


def test_the_same_variant_keeps_everything():
    trained, fresh = made("erf-posenet-dfc"), made("erf-posenet-dfc", seed=1)
    take_over(fresh, trained.state_dict())
    for key, value in trained.state_dict().items():
        torch.testing.assert_close(fresh.state_dict()[key], value)


@pytest.mark.parametrize("other", [made("depthnet", width=0.5), made("posenet")])
def test_another_network_is_refused_and_nothing_changes(other: torch.nn.Module):
    fresh = made("erf-depthnet-dfc")
    before = {key: value.clone() for key, value in fresh.state_dict().items()}
    with pytest.raises(ConfigError):
        take_over(fresh, other.state_dict())
    for key, value in fresh.state_dict().items():
        torch.testing.assert_close(value, before[key])
