"""Initial weights from a trained network of another variant, with the same output at first.

The kernels are kept and only the offsets of deformable layers are new.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from erfsfm.common.errors import ConfigError


def take_over(network: nn.Module, trained: dict[str, Tensor]) -> None:
    """Fill ``network`` with the weights of one that may have deformable layers in other places.

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
            if trained[source].shape != fresh.shape:
                raise ConfigError(
                    f"'{source}' has shape {tuple(trained[source].shape)} where {tuple(fresh.shape)} is needed"
                )
            filled[key] = trained[source]
            known.discard(source)
        elif key.endswith(".bias") and f"{key.removesuffix('bias')}kernel.weight" in trained:
            filled[key] = torch.zeros_like(fresh)
        elif not _moves_taps(key):
            raise ConfigError(f"'{key}' is not among the trained weights")
    strange = sorted(key for key in known if not _moves_taps(key) and not key.endswith(".bias"))
    if strange:
        raise ConfigError(f"'{strange[0]}' has no place in this network")
    network.load_state_dict(filled)


def _elsewhere(key: str) -> str:
    """Name of a convolution's kernel where the other network has it deformable, or plain."""
    if key.endswith(".kernel.weight"):
        return key.removesuffix("kernel.weight") + "weight"
    return key.removesuffix("weight") + "kernel.weight" if key.endswith(".weight") else key


def _moves_taps(key: str) -> bool:
    return ".offset." in key or ".modulator." in key
