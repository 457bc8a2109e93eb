"""Depth of a network as the label of another one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from erfsfm.config import ExperimentConfig
from erfsfm.data.snippets import SnippetDraws, split_recordings
from erfsfm.data.window import HEIGHTS
from erfsfm.inference import DepthPosePredictor
from erfsfm.model_record import find_weights, read_record
from erfsfm.training.run import train
from erfsfm.training.supervision import imitated


def imitation(root: Path) -> ExperimentConfig:
    """An experiment on one drive that imitates the depth of ``sim``."""
    tree: dict[str, dict[str, Any]] = {
        "teacher": {"views": "network", "slam_weights": "sim", "structure_weight": 1},
        "network": {"height": 64, "width": 96, "sources": 2, "depth_width": 0.1, "pose_width": 0.1},
        "data": {"workers": 0, "flip": 1, "zoom": 1, "validation": [], "roots": [root]},
        "loss": {"photometric_weight": 0, "smoothness_weight": 0},
        "training": {"networks": "depth", "batch": 2, "steps": 1},
    }
    return ExperimentConfig.model_validate(tree)


def test_the_label_is_what_the_network_gives(write_root: Callable[..., Path], tmp_path: Path) -> None:
    config = imitation(write_root(tmp_path / "real", 5))
    recordings, _ = split_recordings(config.data)
    sample = SnippetDraws(recordings, config, 1, imitated=imitated(config)).draw(0)
    shown = sample["target"].permute(1, 2, 0).numpy()
    original = np.ascontiguousarray(shown[:, ::-1])  # every image is mirrored
    disparity = 1 / DepthPosePredictor.from_weights("sim", "cpu", "onnx").depth(original)[:, ::-1]
    torch.testing.assert_close(sample["least"], sample["most"])
    wanted = torch.from_numpy(disparity.copy())[None] / HEIGHTS
    torch.testing.assert_close(sample["most"], wanted, rtol=2e-3, atol=1e-4)


def test_it_trains_depth_alone(write_root: Callable[..., Path], tmp_path: Path) -> None:
    output = train(imitation(write_root(tmp_path / "real", 5)), tmp_path / "run", device="cpu")
    assert (output / "last" / "depth.safetensors").is_file()
    assert not (output / "last" / "pose.safetensors").exists()
    record = read_record(output / "last" / "model.yaml")
    assert set(read_record(find_weights("sim") / "model.yaml").trained_on) <= set(record.trained_on)
