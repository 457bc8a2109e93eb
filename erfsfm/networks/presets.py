"""Networks by name: the paper's, and depth networks with a pretrained encoder."""

from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch

from erfsfm.common.errors import ConfigError
from erfsfm.config import NetworkKind
from erfsfm.networks.blocks import Activation, Fidelity, Normalisation, Variant, let_leak
from erfsfm.networks.depth_net import DepthNet
from erfsfm.networks.lite0 import Lite0DepthNet
from erfsfm.networks.pose_net import PoseNet
from erfsfm.networks.receptive_field import Network, multiply_adds, theoretical


@dataclass(frozen=True)
class Preset:
    """One named network: what it predicts, its wide-field convolutions, and whose encoder it has."""

    kind: NetworkKind
    variant: Variant
    encoder: Literal["paper", "lite0"] = "paper"


PRESETS: dict[str, Preset] = {
    "depthnet": Preset("depth", "plain"),
    "erf-depthnet-dilated": Preset("depth", "dilated"),
    "erf-depthnet-dfc": Preset("depth", "dfc"),
    "erf-depthnet-dfcv2": Preset("depth", "dfcv2"),
    "depthnet-lite0": Preset("depth", "plain", "lite0"),
    "erf-depthnet-lite0": Preset("depth", "dfc", "lite0"),
    "posenet": Preset("pose", "plain"),
    "erf-posenet-dilated": Preset("pose", "dilated"),
    "erf-posenet-dfc": Preset("pose", "dfc"),
    "erf-posenet-dfcv2": Preset("pose", "dfcv2"),
}


def build(
    name: str,
    fidelity: Fidelity = "default",
    width: float = 1.0,
    sources: int = 4,
    normalisation: Normalisation = "none",
    activation: Activation = "relu",
) -> Network:
    """Build a network with fresh weights.

    Args:
        name: a key of `PRESETS`.
        fidelity: ``paper`` for the reference's exact layers and initialisation, ``default`` for ours.
        width: multiplier of the hidden channels.
        sources: number of source images of a pose network; a depth network ignores it.
        normalisation: batch norm after every convolution but the heads, or none as published; a pretrained
            encoder has its own, and what follows it has none.
        activation: after every convolution but the heads, as published or leaking a tenth.

    Raises:
        ConfigError: if the name or an option is unknown or out of range.
    """
    if name not in PRESETS:
        raise ConfigError(f"unknown network '{name}'; known: {', '.join(PRESETS)}")
    preset = PRESETS[name]
    if fidelity not in get_args(Fidelity):
        raise ConfigError(
            f"fidelity must be one of {', '.join(get_args(Fidelity))}; got '{fidelity}'"
        )
    if not 0 < width <= 8:
        raise ConfigError(f"width must be above 0 and at most 8; got {width}")
    network: Network
    if preset.encoder == "lite0":
        if fidelity == "paper":
            raise ConfigError(f"{name} is not of the paper: set network.fidelity to default")
        network = Lite0DepthNet(preset.variant, width)
    elif preset.kind == "depth":
        network = DepthNet(preset.variant, fidelity, width, normalisation)
    else:
        network = PoseNet(preset.variant, fidelity, width, sources, normalisation)
    if activation == "leaky":
        let_leak(network)
    return network


def describe(
    fidelity: Fidelity = "default", width: float = 1.0, sources: int = 4
) -> list[dict[str, Any]]:
    """Every preset of a fidelity in numbers; only shapes are computed.

    Returns:
        Objects of ``name``, ``kind``, ``parameters``, ``multiply_adds`` of one forward pass at 416 x 128 or None with
        ``multiply_adds_reason``, and ``receptive_field``: side in pixels at the last encoder layer, at zero offsets.

    Raises:
        ConfigError: if an option is unknown or out of range.
    """
    summaries = []
    for name, preset in PRESETS.items():
        if fidelity == "paper" and preset.encoder != "paper":
            continue
        with torch.device("meta"):
            network = build(name, fidelity, width, sources)
        summary = {
            "name": name,
            "kind": preset.kind,
            "parameters": sum(p.numel() for p in network.parameters()),
        }
        try:
            summary |= {"multiply_adds": multiply_adds(network), "multiply_adds_reason": None}
        except ConfigError as error:
            summary |= {"multiply_adds": None, "multiply_adds_reason": str(error)}
        summaries.append(summary | {"receptive_field": theoretical(network)})
    return summaries
