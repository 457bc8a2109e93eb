"""Trained networks on disk, whole and damaged."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from erfsfm.checkpoint import Model, build_networks, load_model, save_model, take_over
from erfsfm.common.errors import CheckpointError, ConfigError
from erfsfm.config import NetworkConfig
from erfsfm.model_record import ModelRecord, weights_sha256
from erfsfm.networks.presets import build

FILES = ("depth.safetensors", "pose.safetensors")


def fresh(**network: Any) -> Model:
    settings = {"depth_width": 0.0625, "pose_width": 0.125, "normalisation": "batch", "sources": 2}
    config = NetworkConfig.model_validate(settings | network)
    record = ModelRecord(
        network=config, trained_on=["simulated/0-9", "kitti_odometry/00[0:250]"], step=12
    )
    return Model(record, build_networks(config))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_model(tmp_path / "weights", fresh())
    return tmp_path / "weights"


def refusal(name: str | Path) -> str:
    with pytest.raises(CheckpointError) as caught:
        load_model(name)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def states(model: Model) -> list[torch.Tensor]:
    return [
        *model.networks["depth"].state_dict().values(),
        *model.networks["pose"].state_dict().values(),
    ]


@pytest.mark.parametrize(
    "network", [{}, {"depth": "erf-depthnet-dfcv2", "pose": "erf-posenet-dfc", "fidelity": "paper"}]
)
def test_round_trip(tmp_path: Path, network: dict[str, Any]):
    model = fresh(**network)
    save_model(tmp_path, model)
    loaded = load_model(tmp_path)
    assert loaded.record == model.record
    assert all(torch.equal(a, b) for a, b in zip(states(loaded), states(model), strict=True))
    assert not loaded.networks["depth"].training
    assert not loaded.networks["pose"].training


def test_half_precision(tmp_path: Path):
    """Half the size, weights to three digits, the statistics of batch normalisation exact."""
    model = fresh()
    for name, value in model.networks["depth"].state_dict().items():
        if "running_var" in name:
            value.fill_(1e-7)  # half precision would round it to a tenth of its digits
    save_model(tmp_path / "full", model)
    save_model(tmp_path / "half", model, half=True)
    sizes = [(tmp_path / name / "depth.safetensors").stat().st_size for name in ("full", "half")]
    assert sizes[1] < 0.65 * sizes[0]
    loaded = load_model(tmp_path / "half")
    for (name, value), reference in zip(
        loaded.networks["depth"].state_dict().items(), model.networks["depth"].state_dict().values()
    ):
        assert value.dtype == reference.dtype
        if "running_" in name or not value.is_floating_point():
            assert torch.equal(value, reference)
        else:
            torch.testing.assert_close(value, reference, rtol=1e-3, atol=1e-4)


def test_missing_and_unknown_tensors(folder: Path):
    path = folder / "pose.safetensors"
    tensors = load_file(path)
    first = sorted(tensors)[0]
    tensors.pop(first)
    save_file(tensors, path)
    message = refusal(folder)
    assert "another architecture" in message
    assert first in message
    save_file({**load_file(path), first: torch.zeros(1), "extra": torch.zeros(1)}, path)
    assert "extra" in refusal(folder)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "- 1",
        "a: [",
        "[" * 800,
        "format: 1\n",
        "format: 2\nnetwork: {}\ntrained_on: []\n",
        "\x00\x01",
    ],
)
def test_bad_record(folder: Path, text: str):
    (folder / "model.yaml").write_text(text)
    message = refusal(folder)
    assert "not a model record of format 1" in message or "is not YAML" in message


def test_fingerprint_depends_on_both_files(folder: Path, tmp_path: Path):
    before = weights_sha256(folder)
    assert len(before) == 64
    assert weights_sha256(shutil.copytree(folder, tmp_path / "copy")) == before
    for name in FILES:
        save_model(tmp_path / "other", fresh())
        changed = shutil.copytree(folder, tmp_path / f"changed_{name}")
        shutil.copy(tmp_path / "other" / name, changed / name)
        assert weights_sha256(changed) != before


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
def test_a_network_with_zero_offsets_has_the_same_output_in_another_variant(
    first: str, second: str
):
    trained, fresh = made(first), made(second, seed=1)
    for key, value in trained.named_parameters():
        if key.endswith(".bias"):
            torch.nn.init.zeros_(value)  # a deformable kernel has none
    take_over(fresh, trained.state_dict())
    image = torch.rand(1, 3, 64, 96)
    seen = (
        (image,)
        if "depth" in first
        else (image, [image.flip(3), image.flip(2), image, image * 0.5])
    )
    torch.testing.assert_close(fresh(*seen), trained(*seen), rtol=1e-4, atol=1e-5)


def test_another_network_is_refused_and_nothing_changes():
    fresh = made("erf-depthnet-dfc")
    before = {key: value.clone() for key, value in fresh.state_dict().items()}
    for other in (made("depthnet", width=0.5), made("posenet")):
        with pytest.raises(ConfigError):
            take_over(fresh, other.state_dict())
    for key, value in fresh.state_dict().items():
        torch.testing.assert_close(value, before[key])
