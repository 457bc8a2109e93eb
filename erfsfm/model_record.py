"""Folders of trained weights and their record, ``model.yaml``: what was trained, on what, by which command."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, field_validator
from safetensors import SafetensorError
from safetensors.numpy import load_file

from erfsfm.common.config_tree import Section, read_model
from erfsfm.common.errors import CheckpointError
from erfsfm.config import NetworkConfig, NetworkKind

FORMAT: Literal[1] = 1
SHIPPED = Path(__file__).parent / "weights"
KINDS: tuple[NetworkKind, NetworkKind] = ("depth", "pose")


class DepthInput(Section):
    """Size at which the depth network sees single images, where that is not the size of its training."""

    height: int = Field(ge=1, le=4096, description="of the network's input, pixels")
    width: int = Field(ge=1, le=4096, description="of the network's input, pixels")
    disparity: float = Field(
        default=1.0, gt=0, description="factor on its output that keeps the unit of the training"
    )


class ModelRecord(Section):
    """Metadata of a pair of networks: all but their weights."""

    model_config = ConfigDict(allow_inf_nan=True)  # a metric may be undefined

    format: Literal[1] = FORMAT
    network: NetworkConfig
    networks: Literal["both", "depth", "pose"] = Field(
        default="both", description="which of the two are there"
    )
    trained_on: list[str] = Field(
        description="recordings and frame ranges seen in training: the leak record"
    )
    licence: str = Field("unknown: depends on the training data", description="of the weights")
    depth_input: DepthInput | None = Field(
        default=None, description="of single images, if not as in the training"
    )
    step: int = 0
    metrics: dict[str, float] = Field(default_factory=dict, description="of the last validation")
    version: str = ""
    commit: str = ""
    command: str = ""

    @property
    def kinds(self) -> tuple[NetworkKind, ...]:
        """Of the networks that are there."""
        return KINDS if self.networks == "both" else (self.networks,)

    @field_validator("network", mode="before")
    @classmethod
    def _known_keys(cls, network: Any) -> Any:
        """Weights of earlier versions have options that there are no more; their tensors tell whether they matter."""
        if not isinstance(network, dict):
            return network
        return {key: value for key, value in network.items() if key in NetworkConfig.model_fields}


def read_record(path: Path) -> ModelRecord:
    """Read a ``model.yaml``.

    Raises:
        CheckpointError: damaged, or of another format.
    """
    return read_model(
        ModelRecord, path, CheckpointError, f"is not a model record of format {FORMAT}"
    )


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
        raise CheckpointError(f"{folder} holds no model.yaml: it is no output folder of a training")
    raise CheckpointError(
        f"no weights '{name_or_folder}': neither a folder nor one of {', '.join(shipped) or 'none'}"
    )


def tensors_file(folder: Path, kind: NetworkKind) -> Path:
    """The weights of a network in a folder."""
    return folder / f"{kind}.safetensors"


def record_of_whole_weights(name_or_folder: str | Path) -> ModelRecord:
    """The record of weights whose tensors can be read and are finite, which needs no PyTorch.

    Raises:
        CheckpointError: missing or damaged. Whether the tensors fit the networks is known when these are built.
    """
    folder = find_weights(name_or_folder)
    record = read_record(folder / "model.yaml")
    for kind in record.kinds:
        read_tensors(folder, kind)
    return record


def read_tensors(folder: Path, kind: NetworkKind) -> dict[str, NDArray[Any]]:
    """The weights of a network in a folder, by name.

    Raises:
        CheckpointError: missing, damaged, or not finite.
    """
    path = tensors_file(folder, kind)
    try:
        tensors: dict[str, NDArray[Any]] = load_file(path)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(
            f"{path} is damaged or missing ({error}); copy the whole weights folder"
        ) from error
    for key, value in tensors.items():
        if not np.isfinite(value).all():
            raise CheckpointError(
                f"{path}: '{key}' holds NaN or infinite values: use other weights"
            )
    return tensors


def weights_sha256(folder: Path) -> str:
    """SHA-256 of both weight files together, and of what poses are measured in, which changes them."""
    digest = hashlib.sha256()
    for path in (tensors_file(folder, kind) for kind in KINDS):
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
