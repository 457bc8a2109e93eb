"""The paper's tables on a small fake of KITTI, to the end."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest
from small_drives import write_drive, write_root

from erfsfm.common.errors import ConfigError

TOOLS = Path(__file__).parents[2] / "tools"
SMALL = "network.depth_width=0.0625 network.pose_width=0.125 network.height=32 network.width=64"
SHORT = "training.steps=2 training.checkpoint_every=2 training.validate_every=2 data.workers=0"


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.syspath_prepend(str(TOOLS))
    return runpy.run_path(str(TOOLS / "reproduce.py"))


def test_rows_are_those_of_the_paper(tool: dict[str, Any]):
    rows = tool["paper_rows"](["*"])
    assert len(rows) == 36 and len({row.training for row in rows}) == 15
    first = tool["paper_rows"](["table1-posenet-416x128"])
    assert [row.scale for row in first] == ["", "GT", "PoseNet"]
    wanted = "0.021 ± 0.0157, 0.0048 ± 0.0029, 0.0145 ± 0.009, 0.0047 ± 0.0034"
    assert ", ".join(first[0].figures) == wanted
    with pytest.raises(ConfigError, match="table9"):
        tool["paper_rows"](["table9-*"])


@pytest.mark.slow
def test_tables_of_a_small_fake(
    tool: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    kitti = write_root(tmp_path / "kitti", frames=12, sequences=("00", "06", "09", "10"))
    raw, split = write_drive(tmp_path / "raw"), tmp_path / "frames.txt"
    split.write_text("2011_09_26_drive_0099 4\n")
    row, output = "table1-erf-posenet-dfc-416x128", tmp_path / "paper"
    plain = f"--kitti {kitti} --rows {row} --output {output} --device cpu --set {SMALL} {SHORT}"
    words = plain.split()
    tool["main"](words)
    said = capsys.readouterr()
    assert "2 steps of" in said.err and "all trainings: " in said.err
    assert "paper" in said.out and "- | - | - | -" in said.out, "no depth without --raw"
    weights = (output / row / "model.yaml").read_bytes()
    tool["main"]([*words, "--raw", str(raw), "--split", str(split)])
    assert (output / row / "model.yaml").read_bytes() == weights, "nothing is trained again"
    table = (output / "tables.md").read_text().splitlines()
    lines = [line.split(" | ") for line in table if f"`{row}`" in line]
    assert [line[2] for line in lines[:2]] == ["paper", "ours"]
    assert [line[1:3] for line in lines[2:]] == [
        [s, b] for s in ("GT", "PoseNet") for b in ("paper", "ours")
    ]
    assert "-" not in lines[3], "depth was evaluated later"
    kept = json.loads((output / row / "paper.json").read_text())
    assert kept["depth"][0]["images"] == 1


def test_what_is_tested_is_required_first(
    tool: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    kitti = write_root(tmp_path / "kitti", frames=12, sequences=("00", "06", "09"))
    monkeypatch.setattr(sys, "argv", ["reproduce.py"])
    with pytest.raises(SystemExit, match="no sequence 10"):
        tool["main"](["--kitti", str(kitti), "--output", str(tmp_path / "paper")])
    assert not (tmp_path / "paper").exists()
