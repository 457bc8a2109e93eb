"""Conversion of SfMLearner-PyTorch's and ERF-SfMLearner's ``.pth.tar`` checkpoints into our weights.

One file holds one network: DispNetS or PoseExpNet. Nothing in it is executed. The names of plain layers are
those of the published code; deformable layers are recognised by their structure, whatever their names.
Plain and dilated networks have the same weights: the user must tell which it was.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import ValidationError
from torch import Tensor

import erfsfm
from erfsfm.checkpoint import Model, build_networks, fill_network, read_torch, save_model
from erfsfm.common.config_tree import first_problem
from erfsfm.common.errors import CheckpointError
from erfsfm.config import NetworkConfig, NetworkKind
from erfsfm.model_record import ModelRecord, commit

_DEFORMABLE: dict[NetworkKind, dict[tuple[int, ...], str]] = {  # stages with offsets -> preset
    "depth": {(): "depthnet", (1, 2, 3, 4): "erf-depthnet-dfc", (4, 5, 6, 7): "erf-depthnet-dfcv2"},
    "pose": {(): "posenet", (3, 4, 5, 6, 7): "erf-posenet-dfc", (1, 2, 3, 4): "erf-posenet-dfcv2"},
}
_FIRST_CHANNELS: dict[NetworkKind, int] = {"depth": 32, "pose": 16}  # of conv1 at full width
_MARK: dict[NetworkKind, str] = {"depth": "predict_disp1.0.weight", "pose": "pose_pred.weight"}
_ENCODER = re.compile(r"conv(?P<stage>[1-7])\.(?P<place>\d+)\.(?P<rest>.+)")
_DECODER = re.compile(
    r"(?P<block>upconv|iconv|predict_disp|predict_mask)(?P<level>[1-7])\.(?P<rest>.+)"
)


@dataclass(frozen=True)
class OldNetwork:
    """One converted network: its preset, its tensors under our names, and the options that follow from their shapes."""

    path: Path
    kind: NetworkKind
    preset: str
    width: float
    sources: int
    tensors: dict[str, Tensor]


def convert(
    files: Sequence[Path],
    output: Path,
    dilated: bool = False,
    size: tuple[int, int] = (128, 416),
    trained_on: Sequence[str] = (),
    command: str = "",
) -> list[OldNetwork]:
    """Write old checkpoints as one folder that ``--weights`` takes.

    Args:
        files: a depth checkpoint, a pose checkpoint, or one of each in any order.
        output: made if absent; must not hold weights yet.
        dilated: the pose network was the dilated one.
        size: (height, width) of the images that the networks were trained on; not recorded in the files.
        trained_on: recordings seen in training; not recorded in the files.
        command: for the record.

    Raises:
        CheckpointError: unreadable, of another kind, or two of one kind; one line.
    """
    if (output / "model.yaml").exists():
        raise CheckpointError(
            f"{output} holds weights already: name both checkpoints in one command"
        )
    networks: dict[NetworkKind, OldNetwork] = {}
    for file in files:
        network = read_old(file, dilated)
        if network.kind in networks:
            raise CheckpointError(
                f"{networks[network.kind].path} and {file} both hold a {network.kind} network"
            )
        networks[network.kind] = network
    if dilated and "pose" not in networks:
        raise CheckpointError(
            "dilated needs a pose network: the reference's dilated DispNetS cannot run"
        )
    settings: dict[str, Any] = {"fidelity": "paper", "height": size[0], "width": size[1]}
    for kind, network in networks.items():
        settings |= {kind: network.preset, f"{kind}_width": network.width}
    if "pose" in networks:
        settings |= {"sources": networks["pose"].sources}
    try:
        config = NetworkConfig.model_validate(settings)
    except ValidationError as error:
        raise CheckpointError(
            f"no network of ours has such layers: {first_problem(error)}"
        ) from error
    record = ModelRecord(
        network=config,
        networks="both" if len(networks) == 2 else next(iter(networks)),
        trained_on=list(trained_on) or ["unknown"],
        licence="unknown: ask the authors of the weights",
        version=erfsfm.__version__,
        commit=commit(),
        command=command,
    )
    ours = build_networks(record.network)
    for kind, old in networks.items():
        wanted_by = f"the reference's network with the layers of '{old.preset}'"
        fill_network(ours[kind], old.tensors, old.path, wanted_by)
    save_model(output, Model(record, {kind: ours[kind] for kind in networks}))
    return list(networks.values())


def read_old(path: Path, dilated: bool = False) -> OldNetwork:
    """Read one ``.pth.tar`` without executing anything in it.

    Raises:
        CheckpointError: damaged, needs code to be executed, or neither DispNetS nor PoseExpNet.
    """
    tensors = _tensors(path)
    kinds = [kind for kind, mark in _MARK.items() if mark in tensors]
    if not kinds or not any(name.startswith("conv1.0.") for name in tensors):
        some, marks = ", ".join(sorted(tensors)[:3]) or "nothing", " or ".join(_MARK.values())
        raise CheckpointError(
            f"{path} holds neither DispNetS nor PoseExpNet: wanted conv1.0 and {marks}; found {some}"
        )
    kind = kinds[0]
    renamed, stages = _rename(path, kind, tensors)
    preset = _DEFORMABLE[kind].get(stages)
    if preset is None:
        raise CheckpointError(
            f"{path} has deformable layers in conv {stages}; no network of the paper has these"
        )
    if dilated and kind == "pose":
        if stages:
            raise CheckpointError(f"{path} is deformable, not dilated: leave out --dilated")
        preset = "erf-posenet-dilated"
    kernels = (".0.0.weight", ".kernel.weight")
    first = next(
        v
        for name, v in renamed.items()
        if name.startswith("encoder.stages.0.") and name.endswith(kernels)
    )
    head = renamed.get("pose_head.weight")
    return OldNetwork(
        path=path,
        kind=kind,
        preset=preset,
        width=first.shape[0] / _FIRST_CHANNELS[kind],
        sources=len(head) // 6 if head is not None else 4,
        tensors=renamed,
    )


def _tensors(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise CheckpointError(
            f"no file {path}: give a .pth.tar of SfMLearner-PyTorch or ERF-SfMLearner"
        )
    wrong = "is damaged, no checkpoint, or would execute code: get it again"
    loaded = read_torch(path, CheckpointError, wrong)
    state = loaded.get("state_dict", loaded) if isinstance(loaded, Mapping) else None
    if not isinstance(state, Mapping) or not all(
        isinstance(value, Tensor) for value in state.values()
    ):
        raise CheckpointError(
            f"{path} holds no state_dict of tensors: it is no SfMLearner checkpoint"
        )
    for name, value in state.items():
        if not torch.isfinite(value).all():
            raise CheckpointError(
                f"{path}: '{name}' holds NaN or infinite values: use other weights"
            )
    return {str(name).removeprefix("module."): value for name, value in state.items()}


def _rename(
    path: Path, kind: NetworkKind, tensors: Mapping[str, Tensor]
) -> tuple[dict[str, Tensor], tuple[int, ...]]:
    """Tensors under our names, and the encoder stages with deformable layers."""
    renamed: dict[str, Tensor] = {}
    layers: dict[tuple[int, int], dict[str, Tensor]] = {}
    for name, value in tensors.items():
        encoder, decoder = _ENCODER.fullmatch(name), _DECODER.fullmatch(name)
        if encoder:
            layers.setdefault((int(encoder["stage"]), int(encoder["place"])), {})[
                encoder["rest"]
            ] = value
        elif decoder and kind == "pose":
            continue  # explainability masks: only training would need them
        elif decoder:
            # our lists run from the coarsest level to the finest; the old names count from the finest
            block, level, rest = decoder["block"], int(decoder["level"]), decoder["rest"]
            head = f"heads.{4 - level}.{rest.removeprefix('0.')}"
            renamed[head if block == "predict_disp" else f"{block}s.{7 - level}.{rest}"] = value
        elif name.startswith("pose_pred."):
            renamed[name.replace("pose_pred.", "pose_head.", 1)] = value
        else:
            raise CheckpointError(
                f"{path} has a tensor '{name}', which DispNetS and PoseExpNet do not have"
            )
    stages = set()
    for (stage, place), parts in layers.items():
        prefix = f"encoder.stages.{stage - 1}.{place // 2}.0"  # a ReLU stands between the convolutions of a stage
        if parts.keys() <= {"weight", "bias"}:
            ours = parts
        else:
            stages.add(stage)
            ours = _deformable(f"{path}: conv{stage}.{place}", parts)
        renamed |= {f"{prefix}.{rest}": value for rest, value in ours.items()}
    return renamed, tuple(sorted(stages))


def _deformable(where: str, parts: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The three convolutions of a deformable layer by their structure.

    Of a k x k kernel the offsets have 2 k^2 channels, the modulator k^2, both with bias; the kernel itself has none.
    """
    found: dict[str, Tensor] = {}
    for name in sorted({name.rsplit(".", 1)[0] for name in parts}):
        weight, bias = parts.get(f"{name}.weight"), parts.get(f"{name}.bias")
        if weight is None or weight.dim() != 4:
            raise CheckpointError(f"{where}.{name} has no convolution weight")
        taps = weight.shape[2] * weight.shape[3]
        part: Literal["kernel", "offset", "modulator"]
        if bias is None:
            part = "kernel"
        elif weight.shape[0] in (taps, 2 * taps):
            part = "modulator" if weight.shape[0] == taps else "offset"
        else:
            raise CheckpointError(
                f"{where}.{name} fits no part of a modulated deformable layer: {tuple(weight.shape)}"
            )
        found[f"{part}.weight"] = weight
        if bias is not None:
            found[f"{part}.bias"] = bias
    if len(found) != 5:
        raise CheckpointError(
            f"{where} must hold offsets, modulator and kernel; found {', '.join(sorted(parts))}"
        )
    return found
