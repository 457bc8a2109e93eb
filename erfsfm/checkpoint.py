"""Trained networks on disk: a folder with two safetensors files and a readable record.

``model.yaml`` records what was trained, on what, by which command; ``depth.safetensors`` and
``pose.safetensors`` hold numbers only, so that loading never executes code.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import nn

from erfsfm.common.config_tree import dump_yaml
from erfsfm.common.errors import CheckpointError, ConfigError, ErfsfmError
from erfsfm.common.files import write_atomically
from erfsfm.config import NetworkConfig, NetworkKind
from erfsfm.model_record import (
    KINDS,
    ModelRecord,
    find_weights,
    read_record,
    read_tensors,
    tensors_file,
)
from erfsfm.networks.presets import PRESETS, build


@dataclass(frozen=True)
class Model:
    """Trained networks, both or one of them, and their record."""

    record: ModelRecord
    networks: Mapping[NetworkKind, nn.Module]


def build_networks(config: NetworkConfig) -> dict[NetworkKind, nn.Module]:
    """Freshly initialised depth and pose networks.

    Raises:
        ConfigError: an unknown preset, or one of the other kind.
    """
    presets = config.depth, config.pose
    for kind, name in zip(KINDS, presets):
        if name in PRESETS and PRESETS[name].kind != kind:  # `build` refuses unknown names
            known = ", ".join(other for other, preset in PRESETS.items() if preset.kind == kind)
            raise ConfigError(f"network.{kind} must be a {kind} network ({known}); got '{name}'")
    rest = config.sources, config.normalisation, config.activation
    widths = config.depth_width, config.pose_width
    return {
        kind: build(name, config.fidelity, width, *rest)
        for kind, name, width in zip(KINDS, presets, widths)
    }


def save_model(folder: Path, model: Model, half: bool = False) -> None:
    """Write a model; each file appears whole or not at all.

    Args:
        folder: made if absent.
        model: what to write.
        half: store weights in half precision (BatchNorm statistics stay in single precision).
    """
    for kind, net in model.networks.items():
        # through memory: errors of a full disk come from the library as an exception of its own
        tensors = {
            key: value.detach().cpu().contiguous() for key, value in net.state_dict().items()
        }
        for key, value in tensors.items() if half else ():
            if value.is_floating_point() and "running_" not in key:
                tensors[key] = value.half()
        write_atomically(tensors_file(folder, kind), save(tensors))
    write_atomically(folder / "model.yaml", dump_yaml(model.record))


def load_model(name_or_folder: str | Path) -> Model:
    """Read a shipped model by name, or a folder that training wrote.

    Raises:
        CheckpointError: missing, damaged, of another architecture, or not finite; one line.
    """
    folder = find_weights(name_or_folder)
    record = read_record(folder / "model.yaml")
    try:
        networks = build_networks(record.network)
    except ConfigError as error:
        raise CheckpointError(
            f"{folder / 'model.yaml'} names networks that cannot be built: {error}"
        ) from error
    for kind in record.kinds:
        tensors = {key: torch.tensor(value) for key, value in read_tensors(folder, kind).items()}
        fill_network(networks[kind].eval(), tensors, tensors_file(folder, kind), "model.yaml says")
    return Model(record, {kind: networks[kind] for kind in record.kinds})


def fill_network(
    net: nn.Module, tensors: dict[str, torch.Tensor], origin: Path, wanted_by: str
) -> None:
    """Put weights into a network, all of them or none.

    Args:
        net: of the architecture that the weights should have.
        tensors: weights by name.
        origin: file they came from, for the error.
        wanted_by: source of the wanted architecture, for the error.

    Raises:
        CheckpointError: of another architecture.
    """
    wanted = net.state_dict()
    if strange := sorted(wanted.keys() ^ tensors.keys()):
        raise CheckpointError(
            f"{origin} is of another architecture than {wanted_by}: first '{strange[0]}'"
        )
    for key, value in tensors.items():
        if value.shape != wanted[key].shape:
            raise CheckpointError(
                f"{origin}: '{key}' has another shape than {wanted_by}: {tuple(value.shape)}"
            )
    net.load_state_dict({key: value.to(wanted[key].dtype) for key, value in tensors.items()})


def read_torch(path: Path, error: type[ErfsfmError], wrong: str) -> Any:
    """What PyTorch saved, tensors and plain values alone: no code in it can run.

    Raises:
        ErfsfmError: of the given kind, that says what is ``wrong`` with the file.
    """
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Detected pickle protocol")
            return torch.load(path, map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception as cause:  # a damaged file makes PyTorch raise anything, failed assertions too
        raise error(f"{path} {wrong}") from cause


def take_over(network: nn.Module, trained: dict[str, torch.Tensor]) -> None:
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
        source = key
        if key not in trained and key.endswith(
            ".weight"
        ):  # the other network has it deformable, or plain
            stem = key.removesuffix("weight").removesuffix("kernel.")
            source = f"{stem}weight" if key.endswith(".kernel.weight") else f"{stem}kernel.weight"
        if source in trained:
            if trained[source].shape != fresh.shape:
                raise ConfigError(f"'{source}' has another shape than {tuple(fresh.shape)}")
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


def _moves_taps(key: str) -> bool:
    return ".offset." in key or ".modulator." in key
