"""``erfsfm pack`` on the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from typer.testing import CliRunner

from erfsfm.checkpoint import load_model
from erfsfm.cli import app


def test_a_pack_trains_as_it_says(write_root: Callable[..., Path], tmp_path: Path) -> None:
    world = write_root(tmp_path / "world", frames=8, seed=3)
    output = tmp_path / "pack"
    size = ["--set", "network.height=32", "--set", "network.width=64", "--set", "training.steps=2"]
    command = ["pack", "--config", "tiny", "--dataset", str(world), "--output", str(output)]
    result = CliRunner().invoke(app, [*command, *size], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    said = " ".join(result.output.split())
    assert "1 shards with 8 frames and 0 labels" in said and (output / "shards" / "000000.tar").is_file()
    told = ["train", "--config", "tiny", "--dataset", str(output)]
    assert said.endswith(f"train with: erfsfm {' '.join(told)}")
    result = CliRunner().invoke(app, [*told, *size, "--output", str(tmp_path / "run")], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert load_model(tmp_path / "run").record.trained_on == ["simulated/3"]
