"""Weights that are not finite end a run before it writes anything."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from safetensors.torch import load_file, save_file

from slam.commands.cli import main


@pytest.mark.parametrize("kind", ["depth", "pose"])
def test_a_run_refuses_them_in_one_line(
    tiny_weights: Path, tmp_path: Path, kind: str, command_line: Callable[..., tuple[int, str, str]]
) -> None:
    shutil.copytree(tiny_weights, tmp_path / "weights")
    path = tmp_path / "weights" / f"{kind}.safetensors"
    tensors = load_file(path)
    next(value for value in tensors.values() if value.is_floating_point()).view(-1)[0] = float("nan")
    save_file(tensors, path)
    words = ["run", "--frames", "0:4", "--weights", tmp_path / "weights", "--output", tmp_path / "run"]
    code, out, err = command_line(main, "erfsfm-slam", *words)
    assert (code, out) == (1, "")
    assert err.startswith(f"erfsfm-slam: {path}: '")
    assert err.count("\n") == 1
    assert not (tmp_path / "run").exists()
