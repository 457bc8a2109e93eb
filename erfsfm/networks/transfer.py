"""Initial weights from a trained network of another variant, or of half the width, with the same output at first.

Between variants the kernels are kept and only the offsets of deformable layers are new. For twice the width every
channel is duplicated at half its weight (Net2Net, Chen et al. 2016), with a little noise to break the symmetry.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from erfsfm.common.errors import ConfigError

PARTING = 0.05  # of a tensor's standard deviation


def take_over(network: nn.Module, trained: dict[str, Tensor]) -> None:
    """Fill ``network`` with the weights of one that may have deformable layers in other places or half the width.

    A deformable layer that was plain starts with its kernel, zero offsets and a modulator of one. A plain layer that
    was deformable keeps the kernel and drops the convolutions of offsets and modulation. A bias without a counterpart
    is dropped, and a missing one starts at zero.

    Args:
        network: to be filled.
        trained: ``state_dict`` of a network of the same normalisation.

    Raises:
        ConfigError: if the two differ in more than that; the network is left as it was.
    """
    filled = dict(network.state_dict())
    known = set(trained)
    for key, fresh in filled.items():
        source = key if key in trained else _elsewhere(key)
        if source in trained:
            filled[key] = _widened(trained[source], fresh.shape, source)
            known.discard(source)
        elif key.endswith(".bias") and f"{key.removesuffix('bias')}kernel.weight" in trained:
            filled[key] = torch.zeros_like(fresh)
        elif not _moves_taps(key):
            raise ConfigError(f"'{key}' is not among the trained weights")
    strange = sorted(key for key in known if not _moves_taps(key) and not key.endswith(".bias"))
    if strange:
        raise ConfigError(f"'{strange[0]}' has no place in this network")
    network.load_state_dict(filled)


def _widened(value: Tensor, shape: torch.Size, name: str) -> Tensor:
    """A weight at its new shape: outputs duplicated, inputs duplicated at half their weight.

    Input images, and a disparity behind the skip connections, are not duplicated; they are the first layer's whole
    input or a decoder layer's last channel.
    """
    if value.shape == shape:
        return value
    if value.dim() != len(shape) or value.shape[2:] != shape[2:]:
        raise ConfigError(f"'{name}' has shape {tuple(value.shape)} where {tuple(shape)} is needed")
    transposed = "upconv" in name and value.dim() == 4
    if transposed:
        value, shape = value.transpose(0, 1), torch.Size([shape[1], shape[0], *shape[2:]])
    if shape[0] == 2 * len(value):
        value = value.repeat_interleave(2, dim=0)
    if value.dim() > 1 and shape[1] != value.shape[1]:
        single = 2 * value.shape[1] - shape[1]
        twice, once = value.split([value.shape[1] - single, single], dim=1) if single in (0, 1) else (value, value)
        value = torch.cat([twice.repeat_interleave(2, dim=1) / 2, once], dim=1)
    if value.shape != shape:
        raise ConfigError(f"'{name}' can be transferred to its width or twice of it, not as {tuple(shape)}")
    if value.dim() > 1:
        value = value + PARTING * value.std() * torch.randn_like(value)
    return value.transpose(0, 1).contiguous() if transposed else value


def _elsewhere(key: str) -> str:
    """Name of a convolution's kernel where the other network has it deformable, or plain."""
    if key.endswith(".kernel.weight"):
        return key.removesuffix("kernel.weight") + "weight"
    return key.removesuffix("weight") + "kernel.weight" if key.endswith(".weight") else key


def _moves_taps(key: str) -> bool:
    return ".offset." in key or ".modulator." in key
