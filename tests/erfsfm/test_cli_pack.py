"""``erfsfm pack`` on the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from typer.testing import CliRunner

from erfsfm.cli import app


def test_says_what_it_packed_and_how_to_train(write_root: Callable[..., Path], tmp_path: Path) -> None:
    world = write_root(tmp_path / "world", frames=8, seed=3)
    size = ["--set", "network.height=32", "--set", "network.width=64", "--set", "data.validation=[]"]
    command = ["pack", "--config", "tiny", "--dataset", str(world), "--output", str(tmp_path / "pack")]
    result = CliRunner().invoke(app, [*command, *size], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    said = result.output.replace("\n", " ")
    assert "0 real and 8 simulated frames" in said
    assert f"train with: erfsfm train --config tiny --dataset {tmp_path / 'pack'}" in said
    assert (tmp_path / "pack" / "pack.yaml").is_file()
    shards = tmp_path / "shards"
    command = [*command[:-1], str(shards), *size, "--shard-megabytes", "0.1"]
    result = CliRunner().invoke(app, command, catch_exceptions=False)
    assert result.exit_code == 0 and "1 shards with 8 frames and 0 labels" in result.output.replace("\n", " ")
    assert (shards / "shards" / "000000.tar").is_file()
