"""Trained networks on disk: a folder with two safetensors files and a readable record.

``model.yaml`` records what was trained, on what, by which command; ``depth.safetensors`` and
``pose.safetensors`` hold numbers only, so that loading never executes code.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import ConfigDict, Field, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import nn

from erfsfm.config import NetworkConfig
from erfsfm.config_tree import Section, dump_yaml, first_problem
from erfsfm.errors import CheckpointError, ConfigError
from erfsfm.files import write_atomically
from erfsfm.networks.presets import PRESETS, NetworkKind, build
from erfsfm.yaml_file import YamlError, read_yaml

FORMAT: Literal[1] = 1
SHIPPED = Path(__file__).parent / "weights"
KINDS: tuple[NetworkKind, NetworkKind] = ("depth", "pose")
FILES = ("depth.safetensors", "pose.safetensors")


class ModelRecord(Section):
    """Metadata of a pair of networks: all but their weights."""

    model_config = ConfigDict(allow_inf_nan=True)  # a metric may be undefined

    format: Literal[1] = FORMAT
    network: NetworkConfig
    networks: Literal["both", "depth", "pose"] = Field(default="both", description="which of the two are there")
    trained_on: list[str] = Field(description="recordings and frame ranges seen in training: the leak record")
    licence: str = Field("unknown: depends on the training data", description="of the weights")
    step: int = 0
    metrics: dict[str, float] = Field(default_factory=dict, description="of the last validation")
    version: str = ""
    commit: str = ""
    command: str = ""


@dataclass(frozen=True)
class Model:
    """Two networks and their record."""

    record: ModelRecord
    depth_net: nn.Module
    pose_net: nn.Module


class Absent(nn.Module):
    """Placeholder where a folder holds only one of the two networks; using it raises an error."""

    def __init__(self, kind: NetworkKind, folder: Path) -> None:
        super().__init__()
        self.kind = kind
        self._folder = folder

    def forward(self, *_images: Any) -> Any:
        """Refuse.

        Raises:
            CheckpointError: always.
        """
        raise CheckpointError(
            f"{self._folder} holds no {self.kind} network: the other one alone was trained or converted; use weights "
            "that have both"
        )

    def state_dict(self, *_args: Any, **_options: Any) -> Any:
        """Refuse, as `forward` does."""
        return self.forward()


def build_networks(config: NetworkConfig) -> tuple[nn.Module, nn.Module]:
    """Freshly initialised depth and pose networks.

    Raises:
        ConfigError: an unknown preset, or one of the other kind.
    """
    _require_kind("depth", config.depth)
    _require_kind("pose", config.pose)

    def built(name: str, width: float) -> nn.Module:
        # a depth network has no sources, no mask branch, and no alignment
        return build(
            name,
            config.fidelity,
            width,
            config.sources,
            config.normalisation,
            config.masks,
            config.activation,
            config.alignment,
        )

    return built(config.depth, config.depth_width), built(config.pose, config.pose_width)


def _require_kind(kind: NetworkKind, name: str) -> None:
    """Refuse a pose network where depth is wanted, and the reverse; `build` refuses unknown names."""
    if name in PRESETS and PRESETS[name].kind != kind:
        known = ", ".join(other for other, preset in PRESETS.items() if preset.kind == kind)
        raise ConfigError(f"network.{kind} must be a {kind} network ({known}); got '{name}'")


def save_model(folder: Path, model: Model, half: bool = False) -> None:
    """Write a model; each file appears whole or not at all.

    Args:
        folder: made if absent.
        model: what to write.
        half: store weights in half precision (BatchNorm statistics stay in single precision).
    """
    for name, net in zip(FILES, (model.depth_net, model.pose_net)):
        if isinstance(net, Absent):
            continue
        # through memory: errors of a full disk come from the library as an exception of its own
        content = save({key: _stored(key, value, half) for key, value in net.state_dict().items()})
        write_atomically(folder / name, lambda path, content=content: path.write_bytes(content))  # type: ignore[misc]
    text = dump_yaml(model.record)
    write_atomically(folder / "model.yaml", lambda path: path.write_text(text))


def load_model(name_or_folder: str | Path) -> Model:
    """Read a shipped model by name, or a folder that training wrote.

    Raises:
        CheckpointError: missing, damaged, of another architecture, or not finite; one line.
    """
    folder = find_weights(name_or_folder)
    record = read_record(folder / "model.yaml")
    try:
        nets: list[nn.Module] = list(build_networks(record.network))
    except ConfigError as error:
        raise CheckpointError(f"{folder / 'model.yaml'} names networks that cannot be built: {error}") from error
    for index, (kind, name) in enumerate(zip(KINDS, FILES)):
        if record.networks in ("both", kind):
            fill_network(nets[index], _read_tensors(folder / name), folder / name, "model.yaml says")
        else:
            nets[index] = Absent(kind, folder)
    return Model(record, nets[0].eval(), nets[1].eval())


def find_weights(name_or_folder: str | Path) -> Path:
    """The folder of a shipped name or of a path.

    Raises:
        CheckpointError: neither.
    """
    folder = Path(name_or_folder)
    if (folder / "model.yaml").is_file():
        return folder
    shipped = sorted(p.parent.name for p in SHIPPED.glob("*/model.yaml"))
    if str(name_or_folder) in shipped:
        return SHIPPED / str(name_or_folder)
    if folder.is_dir():
        raise CheckpointError(
            f"{folder} holds no model.yaml: it is not an output folder of 'erfsfm train' (or training has not "
            "written weights yet)"
        )
    raise CheckpointError(f"no weights '{name_or_folder}': neither a folder nor one of {', '.join(shipped) or 'none'}")


def weights_sha256(folder: Path) -> str:
    """SHA-256 of both weight files together, and of the alignment of poses, which changes what they give."""
    digest = hashlib.sha256()
    for path in (folder / name for name in FILES):
        digest.update(path.read_bytes() if path.is_file() else b"")
    alignment = read_record(folder / "model.yaml").network.alignment
    digest.update(b"" if alignment == "none" else alignment.encode())
    return digest.hexdigest()


def commit() -> str:
    """The revision of the source tree this runs from; empty outside a checkout or without git."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists() or shutil.which("git") is None:
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def _stored(key: str, value: torch.Tensor, half: bool) -> torch.Tensor:
    statistics = "running_" in key or not value.is_floating_point()
    return value.detach().cpu().contiguous() if statistics or not half else value.detach().cpu().half().contiguous()


def read_record(path: Path) -> ModelRecord:
    """Read a ``model.yaml``.

    Raises:
        CheckpointError: damaged, or of another format.
    """
    try:
        return ModelRecord.model_validate(read_yaml(path))
    except YamlError as error:
        raise CheckpointError(str(error)) from error
    except ValidationError as error:
        raise CheckpointError(f"{path} is not a model record of format {FORMAT}: {first_problem(error)}") from error


def fill_network(net: nn.Module, tensors: dict[str, torch.Tensor], origin: Path, wanted_by: str) -> None:
    """Put weights into a network, all of them or none.

    Args:
        net: of the architecture that the weights should have.
        tensors: weights by name.
        origin: file they came from, for the error.
        wanted_by: source of the wanted architecture, for the error.

    Raises:
        CheckpointError: of another architecture, or not numbers.
    """
    wanted = net.state_dict()
    missing, extra = wanted.keys() - tensors.keys(), tensors.keys() - wanted.keys()
    if missing or extra:
        example = sorted(missing or extra)[0]
        raise CheckpointError(
            f"{origin} is of another architecture than {wanted_by}: {len(missing)} tensors missing, {len(extra)} "
            f"unknown, first '{example}'"
        )
    for key, value in tensors.items():
        if value.shape != wanted[key].shape:
            raise CheckpointError(
                f"{origin}: '{key}' must have shape {tuple(wanted[key].shape)}; got {tuple(value.shape)}: it is of "
                f"another width or preset than {wanted_by}"
            )
        if value.is_floating_point() and not torch.isfinite(value).all():
            raise CheckpointError(
                f"{origin}: '{key}' holds NaN or infinite values: the training diverged or the file is damaged; use "
                "other weights"
            )
    net.load_state_dict({key: value.to(wanted[key].dtype) for key, value in tensors.items()})


def _read_tensors(path: Path) -> dict[str, torch.Tensor]:
    if not path.is_file():
        raise CheckpointError(f"{path} is missing; copy the whole weights folder")
    try:
        tensors: dict[str, torch.Tensor] = load_file(path)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is damaged ({error}); copy it again or train again") from error
    return tensors
